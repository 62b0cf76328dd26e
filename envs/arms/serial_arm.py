"""Serial arms with hinge joints, and how they are built from MJCF files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np

from viapoint.envs.arms.kinematics import Chain, Constants
from viapoint.envs.arms.mjcf import (
    add_obstacles,
    at_zero,
    chain_of,
    in_frame,
    joint_frames,
    moving_with,
    read_spec,
)
from viapoint.envs.common.types import Box
from viapoint.primitives.array_api import Array, namespace_of

STEP = 1e-3
"""Over which differences of postures are taken for the joints' rates and accelerations, [s]."""
EVERY = 8
"""The joints' references are computed at every eighth physics step and run straight in between."""
RESERVE = 0.97
"""Share of the limits of rate and torque that plans may use: what is left corrects them on the way."""
LEAST = 0.01
"""Share of the limit of torque that a joint is taken to have left for moving, however heavy what it holds."""
ORIGIN = "origin"
"""Site at the origin of the world, from which the hand's actuators measure."""

UNSEEN: dict[str, Any] = {"size": (0.001, 0.0, 0.0), "group": 5}
"""Looks of a site that is only there to be measured."""


class Posture(Protocol):
    """Which of an arm's postures belongs to a place of the hand."""

    def __call__(self, hand: Array) -> Array:
        """Joint angles, shape (..., J), [rad], for hand positions of shape (..., 3), [m]."""

    def margin(self, hand: Array) -> Array:
        """How far inside its reach the hand is, shape (...,), [m]; negative where no posture puts it there."""


class Link(NamedTuple):
    """The shape of a link: a capsule that moves with a joint."""

    name: str
    """Of the geom."""
    body: str
    """That has the geom."""
    joint: int
    """Index of the joint."""
    ends: tuple[Constants, Constants]
    """Of its axis, in the joint's frame, [m]."""
    radius: float
    """[m]."""


class Motion(NamedTuple):
    """What the joints do while the hand moves as planned, shape (..., J) each."""

    angle: Array
    """[rad]."""
    rate: Array
    """[rad/s]."""
    torque: Array
    """That the movement takes, [N m]."""
    weight: Array
    """Torque that holds the arm against gravity, [N m]."""


@dataclass(frozen=True, kw_only=True)
class SerialArm:
    """An arm of J hinges, described by numbers; see :class:`~viapoint.envs.arms.base.Arm` for the functions.

    The numbers are read from an MJCF file, see :mod:`viapoint.envs.arms.serial_arm`.
    """

    name: str
    model_file: str
    """The MJCF file among the package's assets, or its text."""
    joint_names: tuple[str, ...]
    hand_site: str
    chain: Chain
    place: Posture
    """The posture for a place of the hand."""
    shape: tuple[Link, ...]
    """The links, from the base to the hand."""
    hand_at: Constants
    """The hand in the last joint's frame, [m]."""
    hand_radius: float
    joint_range: tuple[tuple[float, float], ...]
    velocity_limit: tuple[float, ...]
    """[rad/s]."""
    torque_limit: tuple[float, ...]
    """[N m]."""
    workspace: tuple[tuple[float, ...], tuple[float, ...]]
    joint_stiffness: tuple[float, ...]
    """Of the springs to the posture, [N m/rad]."""
    joint_damping: tuple[float, ...]
    """[N m s/rad]."""
    hand_stiffness: float
    """[N/m]."""
    hand_damping: float
    """[N s/m]."""
    dimension: int = 3

    @property
    def link_radii(self) -> tuple[float, ...]:
        """See :attr:`viapoint.envs.arms.base.Arm.link_radii`."""
        return tuple(link.radius for link in self.shape)

    @property
    def traced(self) -> tuple[str, ...]:
        """See :attr:`viapoint.envs.arms.base.Arm.traced`."""
        return (self.hand_site, *(f"{link.name}_{end}" for link in self.shape for end in (0, 1)))

    def compile(self, n_obstacles: int, whole_arm: bool) -> mujoco.MjModel:
        """See :meth:`viapoint.envs.arms.base.Arm.compile`."""
        spec = read_spec(self.model_file)
        self._add_links(spec, whole_arm)
        self._add_actuators(spec)
        add_obstacles(spec, n_obstacles)
        return spec.compile()

    def hand_position(self, joints: Array) -> Array:
        """See :meth:`viapoint.envs.arms.base.Arm.hand_position`."""
        return self.chain.points(joints, ((len(self.joint_range) - 1, self.hand_at),))[..., 0, :]

    def links(self, joints: Array) -> Array:
        """See :meth:`viapoint.envs.arms.base.Arm.links`."""
        xp = namespace_of(joints)
        places = tuple((link.joint, end) for link in self.shape for end in link.ends)
        points = self.chain.points(joints, places)
        return xp.reshape(points, (*joints.shape[:-1], len(self.shape), 2, 3))

    def inverse_kinematics(self, hand: Array) -> Array:
        """See :meth:`viapoint.envs.arms.base.Arm.inverse_kinematics`."""
        return self.place(hand)

    def reach_margin(self, hand: Array) -> Array:
        """See :meth:`viapoint.envs.arms.base.Arm.reach_margin`."""
        return self.place.margin(hand)

    def required_time_scale(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """See :meth:`viapoint.envs.arms.base.Arm.required_time_scale`.

        Rates scale with the factor's inverse, torques of motion with its square's; those against gravity stay.
        """
        xp = namespace_of(position)
        motion = self._motion(position, velocity, acceleration)
        rates = RESERVE * _limits(self.velocity_limit, position)
        torques = _limits(self.torque_limit, position)
        left = xp.maximum(RESERVE * torques - xp.abs(motion.weight), LEAST * torques)
        fastest = xp.max(xp.abs(motion.rate) / rates, axis=-1)
        strongest = xp.sqrt(xp.max(xp.abs(motion.torque) / left, axis=-1))
        factor = xp.max(xp.maximum(fastest, strongest), axis=-1)
        return xp.where(factor > 1.0, factor, xp.ones_like(factor))

    def controls(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """See :meth:`viapoint.envs.arms.base.Arm.controls`.

        An actuator's force is control - stiffness x place - damping x rate. So the control carries stiffness and
        damping times the references, and a joint's the torque of the inverse dynamics as well.
        """
        xp = namespace_of(position)
        looks = slice(None, None, EVERY)
        motion = self._motion(position[..., looks, :], velocity[..., looks, :], acceleration[..., looks, :])
        stiffness, damping = (_limits(gain, position) for gain in (self.joint_stiffness, self.joint_damping))
        joints = motion.torque + stiffness * motion.angle + damping * motion.rate
        hand = self.hand_stiffness * position + self.hand_damping * velocity
        return xp.concat((hand, _straight_between(joints, position.shape[-2])), axis=-1)

    def _motion(self, position: Array, velocity: Array, acceleration: Array) -> Motion:
        """What the joints do: differences of the postures just before and after give rates and accelerations."""
        xp = namespace_of(position)
        ahead, bow = velocity * STEP, acceleration * (0.5 * STEP * STEP)
        before, now, after = self.place(
            xp.stack((position - ahead + bow, position, position + ahead + bow), axis=0)
        )
        rate, gain = (after - before) * (0.5 / STEP), (after - 2.0 * now + before) * (1.0 / STEP**2)
        return Motion(now, rate, *self.chain.torques(now, rate, gain))

    def _add_links(self, spec: mujoco.MjSpec, whole_arm: bool) -> None:
        """Sites at the links' ends, to record where they are; links that are no obstacle's business touch nothing."""
        data = at_zero(spec.copy().compile())
        frames = self.chain.frames(np.zeros(len(self.joint_range)))
        for link in self.shape:
            body, geom = data.body(link.body), spec.geom(link.name)
            turn = body.xmat.reshape(3, 3)
            for end, point in enumerate(link.ends):
                place = turn.T @ (np.array(frames[link.joint].place(point)) - body.xpos)
                spec.body(link.body).add_site(name=f"{link.name}_{end}", pos=place, **UNSEEN)
            if not whole_arm:
                geom.contype, geom.conaffinity = 0, 0

    def _add_actuators(self, spec: mujoco.MjSpec) -> None:
        """The hand's servo along three axes, and one for each joint."""
        spec.worldbody.add_site(name=ORIGIN, **UNSEEN)
        for gear, name in zip(np.eye(6), ("hand_x", "hand_y", "hand_z"), strict=False):
            while name in self.joint_names:
                name += "_"
            servo = _affine(spec, name, mujoco.mjtTrn.mjTRN_SITE, self.hand_stiffness, self.hand_damping)
            servo.target, servo.refsite, servo.gear = self.hand_site, ORIGIN, gear
        for name, stiffness, damping in zip(
            self.joint_names, self.joint_stiffness, self.joint_damping, strict=True
        ):
            _affine(spec, name, mujoco.mjtTrn.mjTRN_JOINT, stiffness, damping).target = name


def _affine(
    spec: mujoco.MjSpec, name: str, transmission: mujoco.mjtTrn, stiffness: float, damping: float
) -> Any:
    """An actuator whose force is control - stiffness x length - damping x velocity."""
    actuator = spec.add_actuator(name=name, trntype=transmission, biastype=mujoco.mjtBias.mjBIAS_AFFINE)
    actuator.gainprm[0], actuator.biasprm[1:3] = 1.0, (-stiffness, -damping)
    return actuator


def _limits(values: tuple[float, ...], like: Array) -> Array:
    """Numbers as an array of the kind of `like`."""
    xp = namespace_of(like)
    return xp.asarray(values, dtype=like.dtype)


def _straight_between(knots: Array, number: int) -> Array:
    """Values at `number` steps from those at every :data:`EVERY`-th, shape (..., number, U); the last one is held."""
    xp = namespace_of(knots)
    following = xp.concat((knots[..., 1:, :], knots[..., -1:, :]), axis=-2)
    share = xp.asarray(np.arange(EVERY)[:, None] / EVERY, dtype=knots.dtype)
    between = knots[..., :, None, :] + share * (following - knots)[..., :, None, :]
    flat = xp.reshape(between, (*knots.shape[:-2], -1, knots.shape[-1]))
    return flat[..., :number, :]


BANDWIDTH = 20.0
"""Natural frequency of the joints' springs, critically damped, [rad/s]: weak beside the hand's."""
HAND_BANDWIDTH, HAND_DAMPING = 50.0, 0.75
"""Natural frequency of the hand's servo, [rad/s], and its damping relative to the critical."""


def serial_arm(
    model_file: str,
    *,
    name: str,
    joint_names: tuple[str, ...],
    hand_site: str,
    place: Posture,
    workspace: Box,
    hand_gains: tuple[float, float] | None = None,
) -> SerialArm:
    """The record of an arm whose file has everything: capsules for links, a sphere `hand`, and limits.

    Args:
        model_file: Among the package's assets, or a path.
        name: Of the arm.
        joint_names: Hinges from the base to the hand.
        hand_site: Where the hand is.
        place: The posture for a place of the hand.
        workspace: Two opposite corners of the box in which movements start and end, [m].
        hand_gains: Stiffness [N/m] and damping [N s/m] of the hand; by default for its inertia in the middle.
    """
    model = read_spec(model_file).compile()
    data = at_zero(model)
    joints = [model.joint(joint) for joint in joint_names]
    middle = np.asarray(place(np.array(workspace).mean(axis=0)))
    moved, carried = _inertia_at(model, joint_names, hand_site, middle)
    if hand_gains is None:
        hand_gains = carried * HAND_BANDWIDTH**2, 2.0 * HAND_DAMPING * carried * HAND_BANDWIDTH
    return SerialArm(
        name=name,
        model_file=model_file,
        joint_names=joint_names,
        hand_site=hand_site,
        chain=chain_of(model, joint_names),
        place=place,
        shape=_capsules(model, data, joint_names),
        hand_at=in_frame(joint_frames(model, joint_names)[-1], data.site(hand_site).xpos),
        hand_radius=float(model.geom("hand").size[0]),
        joint_range=tuple((float(joint.range[0]), float(joint.range[1])) for joint in joints),
        velocity_limit=tuple(float(v) for v in model.numeric("velocity_limit").data),
        torque_limit=tuple(float(model.jnt_actfrcrange[joint.id, 1]) for joint in joints),
        workspace=workspace,
        joint_stiffness=tuple(float(m) * BANDWIDTH**2 for m in moved),
        joint_damping=tuple(2.0 * float(m) * BANDWIDTH for m in moved),
        hand_stiffness=hand_gains[0],
        hand_damping=hand_gains[1],
    )


def _capsules(model: mujoco.MjModel, data: mujoco.MjData, joint_names: tuple[str, ...]) -> tuple[Link, ...]:
    """The capsules that move with the joints."""
    links, frames = [], joint_frames(model, joint_names)
    for index, joint in enumerate(joint_names):
        for geom in np.flatnonzero(np.isin(model.geom_bodyid, moving_with(model, joint))):
            if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
                continue
            radius, half = model.geom_size[geom, :2]
            axis = half * data.geom_xmat[geom].reshape(3, 3)[:, 2]
            ends: Any = tuple(
                in_frame(frames[index], data.geom_xpos[geom] + side * axis) for side in (1.0, -1.0)
            )
            body = model.body(model.geom_bodyid[geom]).name
            links.append(
                Link(name=model.geom(geom).name, body=body, joint=index, ends=ends, radius=float(radius))
            )
    return tuple(links)


def _inertia_at(
    model: mujoco.MjModel, joint_names: tuple[str, ...], hand_site: str, joints: Any
) -> tuple[Any, float]:
    """What each joint alone would have to turn, [kg m^2], and the hand's inertia, the mean of all directions, [kg]."""
    data = mujoco.MjData(model)
    address = [int(model.joint(name).qposadr[0]) for name in joint_names]
    freedom = [int(model.joint(name).dofadr[0]) for name in joint_names]
    data.qpos[address] = joints
    mujoco.mj_fwdPosition(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site(hand_site).id)
    mobility = jacobian @ np.linalg.solve(full, jacobian.T)
    return np.diag(full)[freedom], float(3.0 / np.trace(mobility))
