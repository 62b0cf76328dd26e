"""Arms as data: a chain of joints, spheres on its links, and the model that MuJoCo simulates."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.kinematics import Chain, Spheres, forward, inverse_dynamics, sphere_centres
from viapoint.envs.arms.spheres import Capsule, LeftOut, cover, overlapping
from viapoint.envs.common.arrays import Float, Int, norm
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import add_to_model
from viapoint.envs.geometry.shapes import as_obstacle
from viapoint.envs.plans import SpaceName

HIDDEN_GROUP = 5  # Group of geoms that MuJoCo does not draw
# Configurations in which bodies get smaller spheres if these overlap though capsules are ROOM apart, [m]
VIEWS, ROOM = 48, 0.0015
COVERED = "covered"  # Custom number in models of which this holds: those whose capsules cover other geoms
COMPARED = 100_000  # Number of configurations in which bodies that never touch are looked for
SAMPLED = 64  # Configurations at which the greatest inertia of the joints is looked for
FARTHEST = 2.0  # Least bound of the coordinates of obstacles, [m]
OBSTACLE_COLOUR = (0.83, 0.52, 0.30, 1.0)  # Colour of obstacles in pictures
WAITING = (0.0, 0.0, -10.0)  # Place of obstacles that are absent, [m]


@dataclass(frozen=True, eq=False, kw_only=True)
class Arm:
    """Arm that moves among obstacles.

    Example:
        >>> from viapoint.envs.arms.registry import arm_of
        >>> arm = arm_of("panda")
        >>> arm.hand(arm.home).round(3).tolist()  # [m]
        [0.307, 0.0, 0.487]
        >>> len(arm.joint_names), arm.space
        (7, 'joints')
    """

    name: str
    """Short name, different from that of every other arm."""
    xml: str
    """MJCF text of the arm and its surroundings."""
    joint_names: tuple[str, ...]
    """Names of the J joints from the base to the tool."""
    joint_range: Float
    """Lowest and highest position of each joint, shape (J, 2), [rad] or [m]."""
    velocity_limit: Float
    """Greatest velocities, shape (J,), [rad/s] or [m/s]; infinite for none."""
    torque_limit: Float
    """Greatest torques or forces, shape (J,), [N m] or [N]."""
    home: Float
    """Joint positions at home, shape (J,)."""
    chain: Chain
    """Kinematics and dynamics."""
    spheres: Spheres
    """Spheres that contain the collision geoms."""
    group_names: tuple[str, ...]
    """Names of the groups of spheres: bodies of the model."""
    left_out: tuple[LeftOut, ...]
    """Pairs of bodies that are not compared with one another, with the reason."""
    excess: float
    """Greatest distance by which a sphere sticks out of a collision geom, [m]."""
    reach: Float
    """Greatest distance of a sphere's centre from the axis of each joint, 1 for sliding joints, shape (J,), [m]."""
    stiffness: Float
    """Stiffness of the joint servos, shape (J,), [N m/rad]."""
    damping: Float
    """Damping of the joint servos, shape (J,), [N m s/rad]."""
    space: SpaceName
    """Space in which movements are planned by default."""
    timestep: float
    """Length of a physics step, [s]."""
    bandwidth: float
    """Natural frequency of the joint servos, [rad/s]."""
    steerable_share: float
    """Share of states in which the torque limits allow the greatest acceleration in control steps."""
    continuous: tuple[str, ...] = ()
    """Names of joints that turn without end in the file; goals of planning are taken modulo a turn."""
    file: str = ""
    """Path of the file that tasks load the arm from; empty for arms that are known by their names."""
    notes: tuple[str, ...] = ()
    """Choices that were made for the arm when it was loaded, and parts that were left out."""

    def __deepcopy__(self, memo: object) -> Arm:
        """Return the arm itself, which never changes, so that copies of a task are equal to it."""
        return self

    @property
    def farthest(self) -> float:
        """Greatest distance of hand and obstacles from the origin along an axis: 2, or what the arm can reach, [m]."""
        lengths = np.linalg.norm((*self.chain.origin, self.chain.tool_origin), axis=1)
        slides = np.abs(self.joint_range[self.chain.sliding]).max(axis=1)
        return max(FARTHEST, float(lengths.sum() + slides.sum()))

    def report(self) -> str:
        """Return what the arm is, and what was chosen for it, as a text of several lines."""
        lines = [repr(self)]
        for j, name in enumerate(self.joint_names):
            unit, effort = ("m", "N") if self.chain.sliding[j] else ("rad", "N m")
            low, high = self.joint_range[j]
            lines.append(
                f"{name}: {low:.4g} to {high:.4g} {unit}, at most {self.velocity_limit[j]:.4g} {unit}/s and "
                f"{self.torque_limit[j]:.4g} {effort}, home {self.home[j]:.4g} {unit}"
            )
        lines += self.notes
        for reason in dict.fromkeys(pair.reason for pair in self.left_out):
            pairs = [f"{pair.first} and {pair.second}" for pair in self.left_out if pair.reason == reason]
            lines.append(f"not compared, {reason}: {'; '.join(pairs)}")
        lines.append(f"spheres reach up to {1e3 * self.excess:.1f} mm beyond the geoms")
        return "\n".join(lines)

    def __repr__(self) -> str:
        """Return name, joints, size, and what was chosen for the arm when it was loaded."""
        parts = [repr(self.name), f"joints={self.joint_names}", f"spheres={len(self.spheres.radius)}"]
        parts += [note for note in self.notes if note.startswith(("tool: ", "velocity limits: ", "home: "))]
        return f"Arm({', '.join(parts)})"

    def hand(self, joints: Any) -> Float:
        """Return places of the tool, shape (..., 3), [m], for joint positions of shape (..., J)."""
        return forward(self.chain, joints)[0]

    def nearest_bodies(self, joints: Float) -> str:
        """Return the names of the two bodies that are nearest to one another at joint positions of shape (J,)."""
        spheres = self.spheres
        centre = sphere_centres(self.chain, spheres, joints)

        def apart(pair: Int) -> float:
            one, other = (slice(spheres.first[group], spheres.first[group + 1]) for group in pair)
            away = norm(centre[one, None] - centre[None, other])
            return float((away - spheres.radius[one, None] - spheres.radius[None, other]).min())

        first, second = min(spheres.pairs, key=apart)
        return f"{self.group_names[first]} and {self.group_names[second]}"

    def compile(self, n_obstacles: int, meshes: Sequence[str] = ()) -> mujoco.MjModel:
        """Return the MuJoCo model of the arm with movable obstacles `obstacle_0`, ..., also registered meshes."""
        spec = mujoco.MjSpec.from_string(self.xml)
        _set_contacts(spec, self)
        _add_actuators(spec, self)
        if meshes:
            store = spec.worldbody.add_body(name="meshes", pos=WAITING)
            shapes = [as_obstacle({"shape": name, "name": f"mesh_{name}"}) for name in meshes]
            add_to_model(spec, shapes, store, contype=0, conaffinity=0, group=HIDDEN_GROUP)
        for row in range(n_obstacles):
            name = f"obstacle_{row}"
            body = spec.worldbody.add_body(name=name, mocap=True, pos=WAITING)
            body.add_geom(
                name=name,
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(0.01, 0.0, 0.0),
                contype=0,
                conaffinity=2,
                condim=1,
                rgba=OBSTACLE_COLOUR,
            )
        return spec.compile()

    def controls(self, position: Float, velocity: Float, acceleration: Float, stride: int = 1) -> Float:
        """Return controls of the actuators that track motions of the joints at T physics steps, shape (N, T, J).

        The torque of an actuator is control - stiffness * position - damping * velocity. So its control is the torque
        of the motion, plus stiffness and damping times the references. MuJoCo's integrator moves the joints by the
        velocity of the next step, and damps that one: it belongs to a time half a step later. Torques are computed
        every `stride` steps; those in between are interpolated linearly.
        """
        motion = [np.ascontiguousarray(part) for part in (position, velocity, acceleration)]
        return _controls(self.chain, self.stiffness, self.damping, self.timestep, stride, *motion)


def arm_from_xml(
    name: str,
    xml: str,
    *,
    joints: Sequence[str],
    tool: str,
    home: Any,
    velocity_limit: Any,
    torque_limit: Any,
    space: SpaceName = "joints",
    bandwidth: float = 50.0,
    steerable_share: float = 0.99,
    exclude: Mapping[frozenset[str], str] | None = None,
    touch: Callable[[str, str, Float], bool] | None = None,
) -> Arm:
    """Return the arm of an MJCF text without actuators, in which all collision geoms are capsules and spheres.

    The joints are hinges and slides from the base to the tool, which is a site; all other bodies move with one of them.
    A body and those of the link before that carry it may pass through one another, and so may pairs in `exclude`, which
    has the reason. With `touch`, so may pairs for which it is False wherever their spheres overlap. The servos of the
    joints are critically damped; `bandwidth` is their natural frequency, [rad/s].

    Raises:
        ValueError: Bodies that are apart at home cannot be told apart.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    chain, links, frames = _chain(model, data, joints, tool)
    capsules = _capsules(model, data, links, frames)
    home = np.array(home, dtype=np.float64)
    carried = {}
    for body, link in links.items():
        carrier = model.body(body)
        while carrier.id:
            carrier = model.body(carrier.parentid[0])
            if links.get(carrier.name, 0) == link - 1 > 0:
                carried[frozenset((carrier.name, body))] = "consecutive links"
    exclude = {**carried, **(exclude or {})}
    ranges = np.array([model.joint(each).range for each in joints])
    low, high = ranges.T
    drawn = np.random.default_rng(0).uniform(low, high, (COMPARED, len(ranges)))
    if touch is not None:
        names, spheres, _, _ = cover(chain, capsules, links, home[None], exclude)
        overlap: Any = overlapping(chain, spheres, drawn)
        for pair, found in zip(spheres.pairs, overlap.T, strict=True):
            first, second = (names[group] for group in pair)
            # Spheres reach beyond the geoms, which may be apart where spheres overlap.
            if not any(touch(first, second, each) for each in drawn[found]):
                exclude[frozenset((first, second))] = f"in contact in none of {COMPARED:,} configurations"

    def room(first: str, second: str, configuration: Float) -> bool:
        """Return True if the capsules of two bodies are ROOM apart in a configuration."""
        move(data, joints, configuration)
        geoms = [np.flatnonzero(model.geom_bodyid == model.body(name).id) for name in (first, second)]
        pairs = itertools.product(*geoms)
        return all(mujoco.mj_geomDistance(model, data, *both, 2.0 * ROOM, None) >= ROOM for both in pairs)

    covered = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, COVERED) >= 0
    views = np.concatenate((home[None], drawn[: VIEWS if covered else 0]))
    names, spheres, left_out, excess = cover(chain, capsules, links, views, exclude, room)
    inertia, _ = greatest_loads(data, joints, ranges)
    # Much damping makes a joint as slow to return as much inertia does.
    inertia = np.maximum(inertia, 0.5 * chain.damping / bandwidth)
    stiffness = inertia * bandwidth**2
    return Arm(
        name=name,
        xml=xml,
        joint_names=tuple(joints),
        joint_range=ranges,
        velocity_limit=np.array(velocity_limit, dtype=np.float64),
        torque_limit=np.array(torque_limit, dtype=np.float64),
        home=home,
        chain=chain,
        spheres=spheres,
        group_names=names,
        left_out=tuple(left_out),
        excess=excess,
        reach=_reach(chain, spheres, ranges),
        stiffness=stiffness,
        damping=np.maximum(2.0 * inertia * bandwidth - chain.damping, 0.0),
        space=space,
        timestep=float(model.opt.timestep),
        bandwidth=bandwidth,
        steerable_share=steerable_share,
    )


def move(data: mujoco.MjData, joints: Sequence[str], positions: Float) -> None:
    """Compute the places of all parts of a model at positions of its joints."""
    data.qpos[[int(data.model.joint(name).qposadr[0]) for name in joints]] = positions
    mujoco.mj_kinematics(data.model, data)


def asset(file: str) -> str:
    """Return the text of a model file of the package."""
    return (files("viapoint.envs") / "assets" / file).read_text(encoding="utf-8")


@compiled
def _controls(
    chain: Chain, stiffness: Float, damping: Float, timestep: float, stride: int, q: Float, v: Float, a: Float
) -> Float:
    """Return controls, see :meth:`Arm.controls`."""
    number, steps, joints = q.shape
    out = np.empty(q.shape)
    before = np.empty(joints)
    after = np.empty(joints)
    for i in range(number):
        for first in range(0, steps, stride):
            if first == 0:
                inverse_dynamics(chain, q[i, 0], v[i, 0], a[i, 0], before)
            following = first + stride
            if following < steps:
                inverse_dynamics(chain, q[i, following], v[i, following], a[i, following], after)
            else:
                for j in range(joints):  # assigned as arrays, Numba would compile messages about shapes
                    after[j] = before[j]
            for k in range(first, min(following, steps)):
                share = (k - first) / stride
                for j in range(joints):
                    torque = before[j] + share * (after[j] - before[j])
                    servo = stiffness[j] * q[i, k, j] + damping[j] * v[i, k, j]
                    # The integrator damps the next velocity, which is the reference half a step later.
                    late = 0.5 * timestep * a[i, k, j]
                    out[i, k, j] = torque + servo + (damping[j] + chain.damping[j]) * late
            for j in range(joints):
                before[j] = after[j]
    return out


def _chain(
    model: mujoco.MjModel, data: mujoco.MjData, joints: Sequence[str], tool: str
) -> tuple[Chain, dict[str, int], list[tuple[Float, Float]]]:
    """Return the chain of some joints, the link that each body of the arm moves with, and frames of links at 0.

    Bodies that are fixed to the world and have collision geoms are the base.
    """
    numbers = [model.joint(name).id for name in joints]
    move(data, joints, np.zeros(len(joints)))
    frames = [(np.eye(3), np.zeros(3))]
    for joint in numbers:
        turn = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
        frames.append((_with_last_axis(turn, data.xaxis[joint]), data.xanchor[joint].copy()))
    links: dict[str, int] = {}
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    moved: list[list[int]] = [[] for _ in joints]
    of_body = {int(model.jnt_bodyid[joint]): link + 1 for link, joint in enumerate(numbers)}
    for body in range(1, model.nbody):
        carrier = int(model.body_weldid[body])
        if carrier in of_body:
            links[model.body(body).name] = of_body[carrier]
            moved[of_body[carrier] - 1].append(body)
        elif carrier == 0 and (collides & (model.geom_bodyid == body)).any():
            links[model.body(body).name] = 0
    mass = np.zeros(len(joints))
    centre = np.zeros((len(joints), 3))
    inertia = np.zeros((len(joints), 3, 3))
    for link, bodies in enumerate(moved):
        turn, place = frames[link + 1]
        mass[link] = model.body_mass[bodies].sum()
        middle = (model.body_mass[bodies, None] * data.xipos[bodies]).sum(axis=0) / mass[link]
        centre[link] = turn.T @ (middle - place)
        inertia[link] = turn.T @ _inertia(model, data, bodies, middle) @ turn
    origin = np.zeros((len(joints), 3))
    rotation = np.zeros((len(joints), 3, 3))
    for link, (turn, place) in enumerate(frames[1:]):
        before, start = frames[link]
        origin[link] = _rounded(before.T @ (place - start))
        rotation[link] = _rounded(before.T @ turn)
    last, end = frames[-1]
    site = model.site(tool).id
    dofs = model.jnt_dofadr[numbers]
    tool_origin = _rounded(last.T @ (data.site_xpos[site] - end))
    chain = Chain(
        origin=origin,
        rotation=rotation,
        sliding=model.jnt_type[numbers] == mujoco.mjtJoint.mjJNT_SLIDE,
        tool_origin=tool_origin,
        tool_rotation=_rounded(last.T @ data.site_xmat[site].reshape(3, 3)),
        mass=mass,
        centre=_rounded(centre),
        inertia=inertia,
        armature=model.dof_armature[dofs].copy(),
        damping=model.dof_damping[dofs].reshape(len(joints), -1)[:, 0].copy(),
        gravity=model.opt.gravity.copy(),
        first_two=(
            math.atan2(origin[1, 1], origin[1, 0]),
            math.atan2(tool_origin[1], tool_origin[0]),
            math.atan2(rotation[1, 1, 0], rotation[1, 0, 0]),
            math.atan2(rotation[0, 1, 0], rotation[0, 0, 0]),
            math.hypot(origin[1, 0], origin[1, 1]),
            math.hypot(tool_origin[0], tool_origin[1]),
        ),
    )
    return chain, links, frames


def _capsules(
    model: mujoco.MjModel, data: mujoco.MjData, links: dict[str, int], frames: list[tuple[Float, Float]]
) -> dict[str, list[Capsule]]:
    """Return the collision geoms of each body of the arm, whose joints are at 0, in the frames of its links."""
    found: dict[str, list[Capsule]] = {}
    for geom in range(model.ngeom):
        name = model.body(model.geom_bodyid[geom]).name
        if name not in links or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        radius, half, _ = model.geom_size[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
            half = 0.0
        elif model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
            raise ValueError(f"collision geoms must be capsules or spheres, not {model.geom(geom).name!r}")
        axis = half * data.geom_xmat[geom].reshape(3, 3)[:, 2]
        turn, place = frames[links[name]]
        centre = data.geom_xpos[geom] - place
        ends = np.stack((turn.T @ (centre - axis), turn.T @ (centre + axis)))
        found.setdefault(name, []).append((ends, float(radius)))
    return found


def _set_contacts(spec: mujoco.MjSpec, arm: Arm) -> None:
    """Enable collisions of exactly the pairs of bodies that must not touch, and moving bodies with obstacles.

    Bit 1 is for the arm with itself; moving bodies have bit 2, too, which is that of obstacles.
    """
    names = arm.group_names
    compared = {frozenset((names[a], names[b])) for a, b in arm.spheres.pairs}
    moving = {name for name, link in zip(names, arm.spheres.link, strict=True) if link > 0}
    for body in spec.bodies:
        for geom in body.geoms:
            if body.name in names and (geom.contype or geom.conaffinity):
                geom.contype = 3 if body.name in moving else 1
                geom.conaffinity = 1
    for first, second in itertools.combinations(names, 2):
        if frozenset((first, second)) not in compared:
            spec.add_exclude(bodyname1=first, bodyname2=second)


def _add_actuators(spec: mujoco.MjSpec, arm: Arm) -> None:
    """Add a servo for each joint whose torque is control - stiffness * position - damping * velocity."""
    for j, name in enumerate(arm.joint_names):
        servo = spec.add_actuator(name=name)
        servo.target = name
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.gaintype = mujoco.mjtGain.mjGAIN_FIXED
        servo.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        servo.gainprm[0] = 1.0
        servo.biasprm[1:3] = -arm.stiffness[j], -arm.damping[j]
        if arm.torque_limit[j] < 1e9:  # MuJoCo takes no infinite range
            servo.forcelimited = True
            servo.forcerange = -arm.torque_limit[j], arm.torque_limit[j]


def greatest_loads(data: mujoco.MjData, joints: Sequence[str], ranges: Float) -> tuple[Float, Float]:
    """Return the greatest inertia, [kg m^2] or [kg], and weight, [N m] or [N], that each joint sees, shape (J,) each.

    Some random configurations within the ranges of the joints, shape (J, 2), are looked at.
    """
    model = data.model
    low, high = ranges.T
    dofs = [int(model.joint(name).dofadr[0]) for name in joints]
    full = np.zeros((model.nv, model.nv))
    gravity = np.zeros(model.nv)
    inertia = np.zeros(len(joints))
    weight = np.zeros(len(joints))
    for configuration in np.random.default_rng(0).uniform(low, high, (SAMPLED, len(joints))):
        move(data, joints, configuration)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        mujoco.mj_fullM(model, data, full)
        mujoco.mj_rne(model, data, 0, gravity)
        inertia = np.maximum(inertia, np.diag(full)[dofs])
        weight = np.maximum(weight, np.abs(gravity[dofs]))
    return inertia, weight


def _reach(chain: Chain, spheres: Spheres, joint_range: Float) -> Float:
    """Return the greatest distance of a sphere from the axis of each joint, 1 for slides, shape (J,), [m]."""
    number = len(chain.mass)
    farthest = np.zeros(number + 2)
    for link in range(number, 0, -1):
        for group in np.flatnonzero(spheres.link == link):
            some = slice(spheres.first[group], spheres.first[group + 1])
            away = np.linalg.norm(spheres.centre[some], axis=1)
            farthest[link] = max(farthest[link], float(away.max()))
        if link < number:
            slide = np.abs(joint_range[link]).max() if chain.sliding[link] else 0.0
            step = float(np.linalg.norm(chain.origin[link])) + slide
            farthest[link] = max(farthest[link], step + farthest[link + 1])
    return np.where(chain.sliding, 1.0, farthest[1 : number + 1])


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, bodies: list[int], centre: Float) -> Float:
    """Return the rotational inertia of bodies together about a point, in world axes (parallel axis theorem)."""
    total = np.zeros((3, 3))
    for body in bodies:
        axes = data.ximat[body].reshape(3, 3)
        away = data.xipos[body] - centre
        total += axes @ np.diag(model.body_inertia[body]) @ axes.T
        total += model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    return total


def _with_last_axis(turn: Float, axis: Float) -> Float:
    """Return the axes of a body, reordered and turned as little as possible, so that the last one is `axis`."""
    nearest = int(np.abs(axis @ turn).argmax())
    first = turn[:, (nearest + 1) % 3]
    first = first - axis * (axis @ first)
    first = first / np.linalg.norm(first)
    return np.stack((first, np.cross(axis, first), axis), axis=-1)


def _rounded(values: Float) -> Float:
    """Return values without rounding errors, so that entries that should be 0 are 0."""
    return np.round(values, 14) + 0.0
