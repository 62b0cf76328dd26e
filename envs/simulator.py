"""MuJoCo's batch engine with one arm and obstacles in each simulation, and metrics of what was executed."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import batch

from viapoint.envs.arms.arm import WAITING, Arm
from viapoint.envs.arms.kinematics import Chain, Spheres, tool_position
from viapoint.envs.common.arrays import Bool, Float, Int
from viapoint.envs.geometry.clearance import (
    Placed,
    bounds_memory,
    fastest,
    movement_clearance,
    obstacle_clearance,
    place,
    travel,
)
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import (
    ABSENT,
    BOX,
    CYLINDER,
    HALF_SPACE,
    MESH,
    Obstacles,
    geom_fields,
    geom_meshes,
    quaternions_of,
)
from viapoint.envs.geometry.shapes import IN_TABLES
from viapoint.envs.outcome import LIMIT_TOLERANCE, EpisodeState, Tolerance

# Parts of a control sequence with moving obstacles: controls, then the obstacles' positions
MOVING = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_MOCAP_POS)
MOST_BETWEEN = 64  # Greatest number of states between two physics steps that are checked for contact


class Simulator:
    """Simulations of an arm among up to `n_obstacles`, which may be some registered meshes, on one thread."""

    def __init__(self, arm: Arm, *, n_obstacles: int, num_envs: int, meshes: Sequence[str] = ()) -> None:
        self.arm = arm
        self.model = arm.compile(n_obstacles, meshes)  # MuJoCo model
        self.timestep = float(self.model.opt.timestep)  # Length of a physics step, [s]
        self.physics_steps = 0  # Physics steps simulated so far, all simulations together
        self.batch = batch.Batch(self.model, num_envs, 1)  # MuJoCo's engine; row i is simulation i
        self.thinnest = _thinnest_geom(self.model)
        """Half the thickness of the thinnest geom of the arm that can touch an obstacle, [m]."""
        self._rest = self.batch.state[0].copy()
        self._geoms = np.array([self.model.geom(f"obstacle_{row}").id for row in range(n_obstacles)], int)
        self._meshes = tuple(meshes)
        fields = []
        if n_obstacles:
            fields = ["geom_type", "geom_size", "geom_rbound", "geom_aabb"]
            fields += ["geom_dataid"] if meshes else []
        self._fields = {name: self.batch.expand(name) for name in fields}
        self._offset = np.zeros((num_envs, n_obstacles, 3))
        self._present = np.zeros((num_envs, n_obstacles), bool)
        self._probe: tuple[mujoco.MjModel, mujoco.MjData] | None = None

    def single(self) -> Simulator:
        """Return a simulator of the same arm and as many obstacles, with one simulation."""
        return Simulator(self.arm, n_obstacles=len(self._geoms), num_envs=1, meshes=self._meshes)

    def place(self, sims: Int, joints: Float, obstacles: Obstacles) -> None:
        """Place the arms of n simulations at rest at joint positions (n, J), and the obstacles of n scenes."""
        self.batch.state[sims] = self._rest
        self.batch.bind("qpos")[sims] = joints
        if not len(self._geoms):
            return
        for name, values in geom_fields(obstacles).items():
            self._fields[name][np.ix_(sims, self._geoms)] = values
        position = obstacles.centre.copy()
        quaternion = quaternions_of(obstacles.rotation)
        names = geom_meshes(obstacles, self._meshes)
        for scene, row in np.argwhere(obstacles.kind == MESH):
            # MuJoCo gives the geom of a mesh a frame of its own, along the axes of inertia.
            mesh = self.model.geom(f"mesh_{names[scene, row]}_0").id
            for name, field in self._fields.items():
                field[sims[scene], self._geoms[row]] = getattr(self.model, name)[mesh]
            position[scene, row] += obstacles.rotation[scene, row] @ self.model.geom_pos[mesh]
            outer = quaternion[scene, row].copy()
            mujoco.mju_mulQuat(quaternion[scene, row], outer, self.model.geom_quat[mesh])
        self._offset[sims] = position - obstacles.centre
        self._present[sims] = obstacles.present
        self.batch.bind("mocap_pos")[sims] = np.where(obstacles.present[..., None], position, WAITING)
        self.batch.bind("mocap_quat")[sims] = quaternion

    def rollout(
        self, sims: Int, controls: Float, steps: Int, centres: Float | None = None, *, resume: bool = False
    ) -> tuple[Float, Bool, Bool]:
        """Run n simulations, in increasing order, each for its own number of steps, 1 to T.

        All run for T steps with controls of shape (n, T, U), and centres of moving obstacles before each step, shape
        (n, T, rows, 3), [m]. To `resume` later, each is set back to its state after its own steps.

        Returns:
            Joint positions after each step, shape (n, T, J), [rad]; True where there is a contact at the state before a
            step, shape (n, T); True for simulations that MuJoCo stopped with a warning, shape (n,).
        """
        number = controls.shape[1]
        warnings = self.batch.warning[sims].copy()
        kept = ["qpos"]
        if resume:
            kept += ["qvel", "qacc_warmstart", *(["act"] if self.model.na else [])]
        if centres is None:
            out = self.batch.rollout(number, controls, record=(*kept, "ncon"), ids=sims)
        else:
            places = np.where(
                self._present[sims][:, None, :, None], centres + self._offset[sims][:, None], WAITING
            )
            sequence = np.concatenate((controls, places.reshape(*controls.shape[:2], -1)), axis=-1)
            out = self.batch.rollout(number, sequence, MOVING, record=(*kept, "ncon"), ids=sims)
        self.physics_steps += number * len(sims)
        each, last = np.arange(len(sims)), steps - 1
        if resume:
            for name in kept:
                self.batch.bind(name)[sims] = out[name][each, last]
            if centres is not None:
                self.batch.bind("mocap_pos")[sims] = places[each, last]
        joints, contact = out["qpos"], out["ncon"] > 0
        # A simulation that stops repeats its record; one that went on after its own steps was sound in them.
        stopped = (joints[each, last] == joints[:, -1]).all(axis=-1)
        warned = (self.batch.warning[sims] > warnings).reshape(len(sims), -1).any(axis=-1)
        unstable = (warned & stopped) | ~np.isfinite(joints[each, last]).all(axis=-1)
        return joints, contact, unstable

    def touches_between(self, sim: int, joints: Float, centres: Float, number: int) -> bool:
        """Return True if there is a contact at `number` states on a straight line between two physics steps.

        Joint positions at both steps have the shape (2, J), and centres of the obstacles (2, rows, 3), [m].
        """
        if self._probe is None:
            model = copy.copy(self.model)  # its fields of obstacles will change
            self._probe = model, mujoco.MjData(model)
        model, data = self._probe
        for share in np.arange(1, number + 1) / (number + 1):
            data.qpos[:] = (1.0 - share) * joints[0] + share * joints[1]
            self.copy_obstacles(sim, model, data, (1.0 - share) * centres[0] + share * centres[1])
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            if data.ncon:
                return True
        return False

    def copy_obstacles(self, sim: int, model: mujoco.MjModel, data: mujoco.MjData, centres: Float) -> None:
        """Give a copy of the model, and its data, the obstacles of a simulation at centres of shape (rows, 3), [m]."""
        if not len(self._geoms):
            return
        for name, field in self._fields.items():
            getattr(model, name)[self._geoms] = field[sim, self._geoms]
        places = np.where(self._present[sim][:, None], centres + self._offset[sim], WAITING)
        data.mocap_pos[:] = places
        data.mocap_quat[:] = self.batch.bind("mocap_quat")[sim].reshape(-1, 4)


def _thinnest_geom(model: mujoco.MjModel) -> float:
    """Return half the thickness of the thinnest geom that takes part in contacts and is no obstacle, [m]."""
    thin = 1.0
    for i in range(model.ngeom):
        geom = model.geom(i)
        if geom.name.startswith("obstacle_") or not (geom.contype[0] or geom.conaffinity[0]):
            continue
        is_round = geom.type[0] in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
        thin = min(thin, float(geom.size[0] if is_round else model.geom_aabb[i, 3:].min()))
    return thin


@compiled
def _thinnest(obstacles: Obstacles, scene: int) -> float:
    """Return half the thickness of the thinnest obstacle of a scene, [m]; that of a mesh is not known and counts 0."""
    thin = 1.0
    for row in range(obstacles.kind.shape[1]):
        kind = obstacles.kind[scene, row]
        if kind in (ABSENT, HALF_SPACE):
            continue
        half = obstacles.size[scene, row, 0]
        if kind in (BOX, CYLINDER):
            half = min(half, obstacles.size[scene, row, 1])
        if kind == BOX:
            half = min(half, obstacles.size[scene, row, 2])
        thin = min(thin, 0.0 if kind in IN_TABLES else half)
    return thin


@compiled
def risky_steps(
    chain: Chain,
    spheres: Spheres,
    reach: Float,
    joints: Float,
    contact: Bool,
    steps: Int,
    obstacles: Obstacles,
    timestep: float,
    placed: Placed,
    thinnest: float,
) -> list[tuple[int, int, int]]:
    """Return steps in which the arm may have passed through something thin: scene, step, and states to look at.

    Bodies move by more than half their thickness in these steps, from a state without contact to another, and both
    clearances together are less than the way: otherwise no state between them can be in contact. `thinnest` is half the
    thickness of the thinnest part of the arm, [m]; the other arguments are those of :func:`measure`.
    """
    found = [(0, 0, 0) for _ in range(0)]
    if obstacles.kind.shape[1] == 0:
        return found
    for scene in range(len(joints)):
        thin = thinnest + _thinnest(obstacles, scene)
        drift = timestep * fastest(obstacles, scene)
        path = joints[scene]
        for k in range(steps[scene] - 1):
            way = travel(reach, path[k], path[k + 1]) + drift
            if way <= 0.5 * thin or contact[scene, k] or contact[scene, k + 1]:
                continue
            apart = 0.0
            for state in (k, k + 1):
                place(chain, spheres, path[state], placed)
                time = timestep * (state + 1)
                apart += obstacle_clearance(spheres, placed, obstacles, scene, time, way, -way)
            if apart < way:  # so a state between may be in contact
                found.append((scene, k, int(min(2.0 * way / thin, MOST_BETWEEN))))
    return found


@compiled
def measure(
    chain: Chain,
    spheres: Spheres,
    reach: Float,
    joints: Float,
    contact: Bool,
    steps: Int,
    obstacles: Obstacles,
    timestep: float,
    placed: Placed,
    planned: Float,
    path: Float,
    goal: Float,
    tolerance: Tolerance,
    of_hand: bool,
    joint_range: Float,
    state: EpisodeState,
    rows: Int,
) -> Int:
    """Add executed segments to the metrics of n episodes, and return how many of their steps count, shape (n,).

    Joint positions after each step, (n, T, J), and contacts before it, (n, T), are those of the simulation. The
    references, (n, T + 1 or more, D), and the joint positions that belong to them begin before the first step. Each
    episode has its own number of steps. At rest, the arm is slow and near its goal, shape (n, D), as the tolerance
    tells; the metrics in `state` are changed at `rows`.
    """
    found = np.empty_like(steps)
    bounds = bounds_memory(chain, spheres, False)
    for scene in range(len(rows)):
        row = rows[scene]
        executed = joints[scene]
        begin, end = state.steps[row], steps[scene]
        for k in range(end):
            if contact[scene, k]:
                # The state before this step is the last one that counts.
                if state.first_contact[row] < 0:
                    state.first_contact[row] = begin + k
                end = k + 1
                break
        hand = state.hand[row]
        before = state.joints[row]
        speed = 0.0
        for k in range(end):
            now = tool_position(chain, executed[k], placed.rotation, placed.origin)
            moved = 0.0
            for axis in range(3):
                moved += (now[axis] - hand[axis]) ** 2
                hand[axis] = now[axis]
            moved = np.sqrt(moved)
            state.path_length[row] += moved
            state.peak_speed[row] = max(state.peak_speed[row], moved / timestep)
            away, square, greatest, rate = 0.0, 0.0, 0.0, 0.0
            for d in range(goal.shape[1]):
                here = now[d] if of_hand else executed[k, d]
                error = here - goal[scene, d]
                away += (here - planned[scene, k + 1, d]) ** 2
                square += error * error
                greatest = max(greatest, abs(error))
            for j in range(executed.shape[1]):
                rate = max(rate, abs(executed[k, j] - before[j]) / timestep)
                before[j] = executed[k, j]
                low = joint_range[j, 0] - LIMIT_TOLERANCE
                high = joint_range[j, 1] + LIMIT_TOLERANCE
                if executed[k, j] < low or executed[k, j] > high:
                    state.within[row] = False
            state.deviation[row] += away
            error = np.sqrt(square) if of_hand else greatest
            speed = moved / timestep if of_hand else rate
            resting = speed < tolerance.speed and error < tolerance.goal
            state.rest[row] = state.rest[row] + 1 if resting else 0
        state.last_speed[row] = speed
        state.steps[row] = begin + end
        # Clearance of what was done, and of what was commanded
        body = chain, spheres, reach
        done = movement_clearance(
            *body, executed[:end], obstacles, scene, timestep, timestep, placed, bounds, 0.0
        )
        state.min_clearance[row] = min(state.min_clearance[row], done[0])
        state.self_clearance[row] = min(state.self_clearance[row], done[1])
        wanted = path[scene, : steps[scene] + 1]
        command = movement_clearance(*body, wanted, obstacles, scene, 0.0, timestep, placed, bounds, 0.0)
        state.planned_clearance[row] = min(state.planned_clearance[row], command[0], command[1])
        found[scene] = end
    return found
