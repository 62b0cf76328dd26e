"""Serial arms with hinge joints, and their construction from MJCF files."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np

from viapoint.envs.arms.kinematics import Chain, Constants
from viapoint.envs.arms.mjcf import (
    Pose,
    add_obstacles,
    bodies_moved_by,
    in_frame,
    joint_frames,
    kinematic_chain,
    read_spec,
    zero_configuration,
)
from viapoint.envs.common.types import Array, Box, Float
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.geometry.segments import segment_axis_squared
from viapoint.envs.geometry.shape import GUARD

DIFFERENCE_STEP = 1e-3
"""Step of the central differences that give joint rates and accelerations, [s]."""
CONTROL_STRIDE = 8
"""Physics steps between two computed joint references; those in between are interpolated linearly."""
LIMIT_SHARE = 0.97
"""Share of the velocity and torque limits that plans may use; feedback uses the rest."""
LEAST_TORQUE_SHARE = 0.01
"""Least share of a joint's torque limit that counts as available for motion, however heavy the arm is."""
JOINT_BANDWIDTH = 20.0
"""Natural frequency of the critically damped joint servos, [rad/s]: weak compared with the hand's servo."""
HAND_BANDWIDTH, HAND_DAMPING_RATIO = 50.0, 0.75
"""Natural frequency of the hand's servo, [rad/s], and its damping ratio."""
ORIGIN = "origin"
"""Name of the site at the world's origin, from which the hand's actuators measure."""
MARKER: dict[str, Any] = {"size": (0.001, 0.0, 0.0), "group": 5}
"""Attributes of an invisible site that only marks a point."""


class InverseKinematics(Protocol):
    """Function that chooses one configuration for each position of the hand."""

    def __call__(self, hand: Array) -> Array:
        """Return joint angles, shape (..., J), [rad], for hand positions of shape (..., 3), [m]."""

    def margin(self, hand: Array) -> Any:
        """Return the distance of the hand inside the reach, shape (...,), [m]; negative out of reach."""


class LinkCapsule(NamedTuple):
    """Capsule, or sphere, of an arm that collides; a link may have any number of them."""

    joint: int
    """Index of the joint that it moves with; -1 for the base, which does not move."""
    ends: tuple[Constants, Constants]
    """Ends of the axis in the joint's frame, [m]; equal for a sphere. The base is in the world's frame."""
    radius: float
    """Radius, [m]."""
    name: str = ""
    """Name of the geom."""
    excess: float = 0.0
    """Greatest distance of a point of the capsule from the geom that it was fitted to, [m]; 0 if it was not fitted."""


class JointMotion(NamedTuple):
    """Motion of the joints while the hand follows a trajectory, shape (..., J) each."""

    angle: Array
    """Angles, [rad]."""
    rate: Array
    """Angular velocities, [rad/s]."""
    torque: Array
    """Torques that the motion takes, [N m]."""
    weight: Array
    """Torques that hold the arm against gravity, [N m]."""


@dataclass(frozen=True, kw_only=True)
class SerialArm:
    """Arm of J hinges that moves its hand in space; see :class:`~viapoint.envs.arms.base.Arm` for its functions.

    :func:`serial_arm` reads the numbers from an MJCF file of the package's form, and
    :func:`~viapoint.envs.arm_import.loader.load_arm` from any MJCF file.
    """

    name: str
    model_file: str
    """MJCF file among the package's assets, or the text of a file."""
    joint_names: tuple[str, ...]
    hand_site: str
    chain: Chain
    ik: InverseKinematics
    """Inverse kinematics."""
    shape: tuple[LinkCapsule, ...]
    """Capsules of the links in order from the base; the last one ends in the hand."""
    base: tuple[LinkCapsule, ...]
    """Capsules of the base, which obstacles may overlap but not contain, and which the arm must not touch."""
    self_pairs: tuple[tuple[int, int], ...]
    """Pairs of capsules that must not touch one another, as indices into `(*shape, *base)`."""
    off_table: tuple[int, ...]
    """Indices of capsules that must not touch the table, the plane z = 0."""
    hand_offset: Constants
    """Hand in the last joint's frame, [m]."""
    hand_radius: float
    joint_range: tuple[tuple[float, float], ...]
    velocity_limit: tuple[float, ...]
    """Greatest angular velocities, [rad/s]."""
    torque_limit: tuple[float, ...]
    """Greatest torques, [N m]."""
    workspace: Box
    joint_stiffness: tuple[float, ...]
    """Stiffness of the joint servos, [N m/rad]."""
    joint_damping: tuple[float, ...]
    """Damping of the joint servos, [N m s/rad]."""
    hand_stiffness: float
    """Stiffness of the hand's servo, [N/m]."""
    hand_damping: float
    """Damping of the hand's servo, [N s/m]."""
    dimension: int = 3

    @property
    def link_radii(self) -> tuple[float, ...]:
        """Radii of the capsules, [m]."""
        return tuple(capsule.radius for capsule in self.shape)

    @property
    def link_joints(self) -> tuple[int, ...]:
        """Index of the joint that each capsule moves with."""
        return tuple(capsule.joint for capsule in self.shape)

    @property
    def traced(self) -> tuple[str, ...]:
        """Names of the sites of the hand and of both ends of each capsule."""
        return (self.hand_site, *(f"{capsule.name}_{end}" for capsule in self.shape for end in (0, 1)))

    def compile(self, n_obstacles: int, whole_arm: bool, meshes: Sequence[str] = ()) -> mujoco.MjModel:
        """Return the MuJoCo model; see :meth:`viapoint.envs.arms.base.Arm.compile`."""
        spec = read_spec(self.model_file)
        self._add_links(spec, whole_arm)
        self._add_actuators(spec)
        add_obstacles(spec, n_obstacles, meshes)
        return spec.compile()

    def hand_position(self, joints: Array) -> Array:
        """Return hand positions; see :meth:`viapoint.envs.arms.base.Arm.hand_position`."""
        return self.chain.points(joints, ((len(self.joint_range) - 1, self.hand_offset),))[..., 0, :]

    def links(self, joints: Array) -> Array:
        """Return the axes of the capsules; see :meth:`viapoint.envs.arms.base.Arm.links`."""
        places = tuple((capsule.joint, end) for capsule in self.shape for end in capsule.ends)
        points = self.chain.points(joints, places)
        return np.reshape(points, (*joints.shape[:-1], len(self.shape), 2, 3))

    def self_clearance(self, joints: Array) -> Array:
        """Return the clearance of the arm from itself; see :meth:`viapoint.envs.arms.base.Arm.self_clearance`."""
        links = self.links(joints)
        base = np.array([capsule.ends for capsule in self.base], dtype=links.dtype).reshape(-1, 2, 3)
        ends = np.concat((links, np.broadcast_to(base, (*links.shape[:-3], *base.shape))), axis=-3)
        radii = np.array([capsule.radius for capsule in (*self.shape, *self.base)])
        least = np.full_like(links[..., 0, 0, 0], MAX_CLEARANCE)
        if self.self_pairs:
            least = np.minimum(least, capsule_pair_clearance(ends, radii, self.self_pairs).min(axis=-1))
        if self.off_table:
            some = list(self.off_table)
            height = links[..., 2][..., some, :].min(axis=-1) - np.asarray(radii[some], dtype=links.dtype)
            least = np.minimum(least, height.min(axis=-1))
        return np.asarray(least)

    def inverse_kinematics(self, hand: Array) -> Array:
        """Return joint angles; see :meth:`viapoint.envs.arms.base.Arm.inverse_kinematics`."""
        return self.ik(hand)

    def reach_margin(self, hand: Array) -> Any:
        """Return the distance inside the reach; see :meth:`viapoint.envs.arms.base.Arm.reach_margin`."""
        return self.ik.margin(hand)

    def required_time_scale(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the time scale; see :meth:`viapoint.envs.arms.base.Arm.required_time_scale`.

        A movement that takes s times as long has 1/s of the rates, 1/s^2 of the torques of motion, and the same torques
        against gravity (J. M. Hollerbach, Dynamic scaling of manipulator trajectories, 1984).
        """
        motion = self._joint_motion(position, velocity, acceleration)
        rates = LIMIT_SHARE * _limits(self.velocity_limit, position)
        torques = _limits(self.torque_limit, position)
        left = np.maximum(LIMIT_SHARE * torques - np.abs(motion.weight), LEAST_TORQUE_SHARE * torques)
        fastest = np.max(np.abs(motion.rate) / rates, axis=-1)
        strongest = np.sqrt(np.max(np.abs(motion.torque) / left, axis=-1))
        factor = np.max(np.maximum(fastest, strongest), axis=-1)
        return np.where(factor > 1.0, factor, 1.0)

    def controls(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return controls; see :meth:`viapoint.envs.arms.base.Arm.controls`.

        An actuator's force is control - stiffness * position - damping * velocity. So its control is stiffness and
        damping times the references, and for a joint also the torque of the inverse dynamics (feedforward).
        """
        strided = (part[..., ::CONTROL_STRIDE, :] for part in (position, velocity, acceleration))
        motion = self._joint_motion(*strided)
        stiffness, damping = (_limits(gain, position) for gain in (self.joint_stiffness, self.joint_damping))
        joints = motion.torque + stiffness * motion.angle + damping * motion.rate
        hand = self.hand_stiffness * position + self.hand_damping * velocity
        return np.concat((hand, _interpolate(joints, position.shape[-2])), axis=-1)

    def _joint_motion(self, position: Array, velocity: Array, acceleration: Array) -> JointMotion:
        """Return the joints' motion by central differences of the inverse kinematics along the hand's parabola."""
        ahead, bow = velocity * DIFFERENCE_STEP, acceleration * (0.5 * DIFFERENCE_STEP * DIFFERENCE_STEP)
        before, now, after = self.ik(
            np.stack((position - ahead + bow, position, position + ahead + bow), axis=0)
        )
        rate = (after - before) * (0.5 / DIFFERENCE_STEP)
        gain = (after - 2.0 * now + before) * (1.0 / DIFFERENCE_STEP**2)
        return JointMotion(now, rate, *self.chain.torques(now, rate, gain))

    def _add_links(self, spec: mujoco.MjSpec, whole_arm: bool) -> None:
        """Add sites at the capsules' ends, from which the simulation records them; let links collide or not."""
        data = zero_configuration(spec.copy().compile())
        frames = self.chain.frames(np.zeros(len(self.joint_range)))
        for capsule in self.shape:
            geom = spec.geom(capsule.name)
            body = data.body(geom.parent.name)
            turn = body.xmat.reshape(3, 3)
            for end, point in enumerate(capsule.ends):
                place = turn.T @ (np.array(frames[capsule.joint].transform(point)) - body.xpos)
                geom.parent.add_site(name=f"{capsule.name}_{end}", pos=place, **MARKER)
            if not whole_arm:
                geom.contype, geom.conaffinity = 0, 0

    def _add_actuators(self, spec: mujoco.MjSpec) -> None:
        """Add a servo of the hand along each axis, and one of each joint."""
        spec.worldbody.add_site(name=ORIGIN, **MARKER)
        for gear, name in zip(np.eye(6), ("hand_x", "hand_y", "hand_z"), strict=False):
            while name in self.joint_names:
                name += "_"
            servo = _add_servo(spec, name, mujoco.mjtTrn.mjTRN_SITE, self.hand_stiffness, self.hand_damping)
            servo.target, servo.refsite, servo.gear = self.hand_site, ORIGIN, gear
        for name, stiffness, damping in zip(
            self.joint_names, self.joint_stiffness, self.joint_damping, strict=True
        ):
            _add_servo(spec, name, mujoco.mjtTrn.mjTRN_JOINT, stiffness, damping).target = name


def capsule_pair_clearance(ends: Array, radii: Float, pairs: Sequence[tuple[int, int]]) -> Array:
    """Return the clearance of P pairs of capsules, shape (..., P), [m].

    Args:
        ends: Ends of the axes of C capsules, shape (..., C, 2, 3), [m].
        radii: Radii, shape (C,), [m].
        pairs: Pairs of indices of capsules.
    """
    first, second = (list(each) for each in zip(*pairs, strict=True))
    # Each component is an array (capsules, ...): the operations are passes over contiguous memory.
    start = [np.moveaxis(ends[..., 0, i], -1, 0) for i in range(3)]
    axis = [np.moveaxis(ends[..., 1, i], -1, 0) - part for i, part in enumerate(start)]
    gap = [part[first] - part[second] for part in start]
    squared = segment_axis_squared(gap, *([part[some] for part in axis] for some in (first, second)))
    distance = np.moveaxis(np.sqrt(squared + GUARD), 0, -1)
    return np.asarray(distance - np.asarray(radii[first] + radii[second], dtype=ends.dtype))


def serial_arm(
    model_file: str,
    *,
    name: str,
    joint_names: tuple[str, ...],
    hand_site: str,
    ik: InverseKinematics,
    workspace: Box,
    hand_gains: tuple[float, float] | None = None,
) -> SerialArm:
    """Return the arm of a complete MJCF file: named capsules and spheres for links and base, a sphere `hand`, limits.

    Links touch one another, the base or the table `table` where their contact bits allow it. Within the reach of the
    inverse kinematics they must not: plans are not checked for it.

    Args:
        model_file: File among the package's assets, a path, or the text of a file.
        name: Name of the arm.
        joint_names: Hinges from the base to the hand.
        hand_site: Site at the hand's position.
        ik: Inverse kinematics.
        workspace: Two opposite corners of the box in which movements start and end, [m].
        hand_gains: Stiffness [N/m] and damping [N s/m] of the hand's servo; by default those of its effective mass in
            the middle of the workspace.
    """
    model = read_spec(model_file).compile()
    joints = [model.joint(joint) for joint in joint_names]
    middle = np.asarray(ik(np.array(workspace).mean(axis=0)))
    inertias, hand_mass = _effective_inertias(model, joint_names, hand_site, middle)
    if hand_gains is None:
        hand_gains = hand_mass * HAND_BANDWIDTH**2, 2.0 * HAND_DAMPING_RATIO * hand_mass * HAND_BANDWIDTH
    hand = zero_configuration(model).site(hand_site).xpos
    shape = _link_capsules(model, joint_names)
    fixed = [int(body) for body in np.flatnonzero(model.body_weldid == 0)]
    base = tuple(_capsules_of(model, fixed, -1, (np.eye(3), np.zeros(3))))
    return SerialArm(
        name=name,
        model_file=model_file,
        joint_names=joint_names,
        hand_site=hand_site,
        chain=kinematic_chain(model, joint_names),
        ik=ik,
        shape=shape,
        base=base,
        self_pairs=_self_pairs(model, [capsule.name for capsule in (*shape, *base)]),
        off_table=tuple(i for i, capsule in enumerate(shape) if _meets_table(model, capsule.name)),
        hand_offset=in_frame(joint_frames(model, joint_names)[-1], hand),
        hand_radius=float(model.geom("hand").size[0]),
        joint_range=tuple((float(joint.range[0]), float(joint.range[1])) for joint in joints),
        velocity_limit=tuple(float(v) for v in model.numeric("velocity_limit").data),
        torque_limit=tuple(float(model.jnt_actfrcrange[joint.id, 1]) for joint in joints),
        workspace=workspace,
        joint_stiffness=tuple(float(m) * JOINT_BANDWIDTH**2 for m in inertias),
        joint_damping=tuple(2.0 * float(m) * JOINT_BANDWIDTH for m in inertias),
        hand_stiffness=hand_gains[0],
        hand_damping=hand_gains[1],
    )


def _link_capsules(model: mujoco.MjModel, joint_names: tuple[str, ...]) -> tuple[LinkCapsule, ...]:
    """Return the capsules and spheres that move with the joints, except the hand."""
    links = []
    for index, (joint, frame) in enumerate(zip(joint_names, joint_frames(model, joint_names), strict=True)):
        links += _capsules_of(model, bodies_moved_by(model, joint), index, frame)
    return tuple(links)


def _capsules_of(model: mujoco.MjModel, bodies: list[int], joint: int, frame: Pose) -> list[LinkCapsule]:
    """Return the capsules and spheres of some bodies, except the hand, in a joint's frame."""
    data, found = zero_configuration(model), []
    for geom in np.flatnonzero(np.isin(model.geom_bodyid, bodies)):
        long, name = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE, model.geom(geom).name
        if not (long or model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE) or name == "hand":
            continue
        radius, half = model.geom_size[geom, :2]
        axis = (half if long else 0.0) * data.geom_xmat[geom].reshape(3, 3)[:, 2]
        first, second = (in_frame(frame, data.geom_xpos[geom] + side * axis) for side in (1.0, -1.0))
        found.append(LinkCapsule(joint, (first, second), float(radius), name))
    return found


def _self_pairs(model: mujoco.MjModel, names: list[str]) -> tuple[tuple[int, int], ...]:
    """Return the pairs of geoms that MuJoCo lets collide, as indices into their names.

    Geoms that move together, those of a link and of the one that carries it, excluded pairs of bodies and geoms whose
    contact bits do not match never collide.
    """
    weld, excluded = model.body_weldid, {int(signature) for signature in model.exclude_signature}

    def collide(first: int, second: int) -> bool:
        one, other = (int(weld[model.geom_bodyid[geom]]) for geom in (first, second))
        carries = any(a and int(weld[model.body_parentid[b]]) == a for a, b in ((one, other), (other, one)))
        bodies = sorted(int(model.geom_bodyid[geom]) for geom in (first, second))
        bits = model.geom_contype[first] & model.geom_conaffinity[second]
        bits |= model.geom_contype[second] & model.geom_conaffinity[first]
        return bool(bits) and one != other and not carries and (bodies[0] << 16) + bodies[1] not in excluded

    geoms = [model.geom(name).id for name in names]
    pairs = itertools.combinations(range(len(geoms)), 2)
    return tuple((i, j) for i, j in pairs if collide(geoms[i], geoms[j]))


def _meets_table(model: mujoco.MjModel, name: str) -> bool:
    """Return True if a geom and the table collide."""
    geom, table = model.geom(name), model.geom("table")
    return bool(geom.contype & table.conaffinity | table.contype & geom.conaffinity)


def _effective_inertias(
    model: mujoco.MjModel, joint_names: tuple[str, ...], hand_site: str, joints: Float
) -> tuple[Float, float]:
    """Return the inertia about each joint, shape (J,), [kg m^2], and the hand's effective mass, [kg].

    The mass is the harmonic mean over all directions, 3 / trace(J M^-1 J^T), with the mass matrix M and the Jacobian J
    of the hand (O. Khatib, A unified approach for motion and force control of robot manipulators, 1987).
    """
    data = mujoco.MjData(model)
    address = [int(model.joint(name).qposadr[0]) for name in joint_names]
    freedom = [int(model.joint(name).dofadr[0]) for name in joint_names]
    data.qpos[address] = joints
    mujoco.mj_fwdPosition(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site(hand_site).id)
    mobility = jacobian @ np.linalg.solve(mass, jacobian.T)
    return np.diag(mass)[freedom], float(3.0 / np.trace(mobility))


def _add_servo(
    spec: mujoco.MjSpec, name: str, transmission: mujoco.mjtTrn, stiffness: float, damping: float
) -> Any:
    """Add an actuator whose force is control - stiffness * length - damping * velocity."""
    actuator = spec.add_actuator(name=name, trntype=transmission, biastype=mujoco.mjtBias.mjBIAS_AFFINE)
    actuator.gainprm[0], actuator.biasprm[1:3] = 1.0, (-stiffness, -damping)
    return actuator


def _limits(values: tuple[float, ...], like: Array) -> Array:
    """Return numbers as an array of the precision of another."""
    return np.asarray(values, dtype=like.dtype)


def _interpolate(knots: Array, number: int) -> Array:
    """Return values at `number` steps, linear between knots (..., K, U) at every CONTROL_STRIDE-th; the last holds."""
    following = np.concat((knots[..., 1:, :], knots[..., -1:, :]), axis=-2)
    share = np.asarray(np.arange(CONTROL_STRIDE)[:, None] / CONTROL_STRIDE, dtype=knots.dtype)
    between = knots[..., :, None, :] + share * (following - knots)[..., :, None, :]
    flat = np.reshape(between, (*knots.shape[:-2], -1, knots.shape[-1]))
    return flat[..., :number, :]
