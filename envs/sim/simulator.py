"""Batch simulator of one arm among obstacles, on MuJoCo's batch engine."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import batch
from numpy.typing import NDArray

from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import in_space, norm
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.narrow_phase import LinkPositions

OUT_OF_THE_WAY = np.array([0.0, 0.0, -10.0])
"""Position of absent obstacles, [m]."""

MOVING = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_MOCAP_POS)
"""Parts of a control sequence with moving obstacles: controls, then the obstacles' centres."""


class SimulationLog(NamedTuple):
    """Record of n simulations over T physics steps."""

    joints: Float
    """Joint angles after each step, shape (n, T, J), [rad]."""
    contact: NDArray[np.bool_]
    """True where arm and obstacle touch at the state before a step, shape (n, T)."""
    unstable: NDArray[np.bool_]
    """True for simulations that MuJoCo stopped with a warning, shape (n,)."""
    traced: LinkPositions | None
    """Positions of the arm's traced sites before each step; None without such sites."""


class Simulator:
    """MuJoCo's batch engine with one arm and capsules of any place and size in each simulation."""

    def __init__(
        self, collision_model: CollisionModel, *, n_obstacles: int, num_envs: int, threads: int
    ) -> None:
        """Compile one model and allocate `num_envs` simulations on `threads` threads (0: one for each core)."""
        self.collision_model, self.arm = collision_model, collision_model.arm
        self.model = self.arm.compile(n_obstacles, collision_model.whole_arm)
        self.timestep = float(self.model.opt.timestep)
        """Length of a physics step, [s]."""
        self.physics_steps = 0
        """Physics steps simulated so far, all simulations together."""
        self.batch = batch.Batch(self.model, num_envs, threads)
        """MuJoCo's batch engine; row i of its state is simulation i."""
        self._rest_state = self.batch.state[0].copy()
        self.recorded = ("qpos", "ncon", "site_xpos") if self.arm.traced else ("qpos", "ncon")
        """Quantities that the engine records at every step."""
        sites = [self.model.site(name).id for name in self.arm.traced]
        self._traced = (sites[0], np.array(sites[1:]).reshape(-1, 2)) if sites else None
        self._geoms = [self.model.geom(f"obstacle_{row}").id for row in range(n_obstacles)]
        if n_obstacles:
            self._sizes = self.batch.expand("geom_size")
            self._bounds = self.batch.expand("geom_rbound")
            self._boxes = self.batch.expand("geom_aabb")

    def place(
        self, sims: NDArray[np.int64], joints: Float, obstacles: Float, present: NDArray[np.bool_]
    ) -> None:
        """Place arms at rest, and obstacles.

        Args:
            sims: The simulations, shape (n,).
            joints: Shape (n, J), [rad].
            obstacles: Rows (centre D, half-axis D, radius), shape (n, rows, 2 D + 1), [m].
            present: True for rows that are obstacles, shape (n, rows).
        """
        self.batch.state[sims] = self._rest_state
        self.batch.bind("qpos")[sims] = joints
        if not self._geoms:
            return
        dimension = (obstacles.shape[-1] - 1) // 2
        centre = in_space(obstacles[..., :dimension])
        axis = in_space(obstacles[..., dimension : 2 * dimension])
        half = norm(axis)
        radius = obstacles[..., -1]
        self.batch.bind("mocap_pos")[sims] = np.where(present[..., None], centre, OUT_OF_THE_WAY)
        self.batch.bind("mocap_quat")[sims] = _turn_up_to(axis, half)
        self._resize(sims, np.where(present, radius, 0.01), np.where(present, half, 0.0))

    def rollout(self, sims: NDArray[np.int64], controls: Float) -> SimulationLog:
        """Run simulations under controls, all for the same number of steps.

        Args:
            sims: The simulations in increasing order, shape (n,).
            controls: Shape (n, T, U).
        """
        steps = controls.shape[1]
        warnings = self._warnings(sims)
        out = self.batch.rollout(steps, controls, record=self.recorded, ids=sims)
        self.physics_steps += steps * len(sims)
        unstable = (self._warnings(sims) > warnings) | ~_finite(out["qpos"])
        traced = LinkPositions(out["site_xpos"], *self._traced) if self._traced else None
        return SimulationLog(out["qpos"], out["ncon"] > 0, unstable, traced)

    def rollout_among_moving(
        self, sims: NDArray[np.int64], controls: Float, places: Float, steps: NDArray[np.int64]
    ) -> SimulationLog:
        """Run simulations under controls among moving obstacles, each for its own number of steps.

        All run for the greatest number of steps; then each is set back to its state after its own steps.

        Args:
            sims: The simulations in increasing order, shape (n,).
            controls: Shape (n, T, U).
            places: Centres of the obstacles before each step, NaN for absent ones, shape (n, T, rows, D), [m].
            steps: Physics steps of each simulation, 1 to T, shape (n,).
        """
        number = controls.shape[1]
        warnings = self._warnings(sims)
        absent = np.isnan(places[..., :1])
        where = np.where(absent, OUT_OF_THE_WAY, in_space(places)).reshape(*controls.shape[:2], -1)
        kept = ("qpos", "qvel", "qacc_warmstart", *(("act",) if self.model.na else ()))
        out = self.batch.rollout(
            number, np.concatenate((controls, where), axis=-1), MOVING, record=(*kept, "ncon"), ids=sims
        )
        self.physics_steps += number * len(sims)
        each, last = np.arange(len(sims)), steps - 1
        for name in kept:
            self.batch.bind(name)[sims] = out[name][each, last]
        joints, contact = out["qpos"], out["ncon"] > 0
        # A simulation that stops repeats its record; one that went on after its own steps was sound in them.
        stopped = (joints[each, last] == joints[:, -1]).all(axis=-1)
        unstable = (self._warnings(sims) > warnings) & stopped | ~np.isfinite(joints[each, last]).all(axis=-1)
        return SimulationLog(joints, contact, unstable, None)

    def data(self, sim: int, joints: Float) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return model and data of one simulation with the arm at `joints`, for rendering."""
        model, data = self.batch.get_model(sim), self.batch.get_data(sim)
        data.qpos[:] = joints
        mujoco.mj_forward(model, data)
        return model, data

    def _warnings(self, sims: NDArray[np.int64]) -> Any:
        return self.batch.warning[sims].reshape(len(sims), -1).sum(axis=-1)

    def _resize(self, sims: NDArray[np.int64], radius: Float, half: Float) -> None:
        """Set the sizes of the capsules and everything that MuJoCo derived from them when it compiled the model."""
        rows = np.ix_(sims, self._geoms)
        length = half + radius
        self._sizes[rows] = np.stack((radius, half, np.zeros_like(half)), axis=-1)
        self._bounds[rows] = length
        self._boxes[rows] = np.stack((*[np.zeros_like(half)] * 3, radius, radius, length), axis=-1)


def _turn_up_to(axis: Float, half: Float) -> Float:
    """Return the quaternion that turns the z axis, along which MuJoCo's capsules lie, to `axis`."""
    lying = half > 1e-9
    unit = np.where(lying[..., None], axis / np.where(lying, half, 1.0)[..., None], (0.0, 0.0, 1.0))
    unit = np.where(unit[..., 2:] < 0.0, -unit, unit)  # a capsule has no sense of direction
    x, y, z = (unit[..., i] for i in range(3))
    length = np.sqrt(2.0 * (1.0 + z))
    return np.stack(((1.0 + z) / length, -y / length, x / length, np.zeros_like(z)), axis=-1)


def _finite(joints: Float) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(joints).all(axis=(1, 2)))
