"""An arm of hinges, one after the other, whose hand moves in space: a record, and how it is driven.

A Cartesian impedance holds the hand to its reference, a weak spring holds every joint to the posture that belongs to
it, and none of them has to pull: each joint is given the torque that the planned movement takes by inverse dynamics.
All of these are actuators of MuJoCo, so they run in C at every physics step, gravity compensated, within the joints'
torque limits. As the posture is a function of the hand's place, and the springs keep the joints to it, the links of a
planned movement are known before it is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np

from viapoint.envs._arrays import Array, namespace_of
from viapoint.envs.arms.chain import Chain, Constants
from viapoint.envs.arms.models import at_zero, read_spec
from viapoint.envs.arms.obstacles import add_obstacles

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
    """An arm of J hinges, described by numbers; see :class:`~viapoint.envs.arms.arm.Arm` for the functions.

    The numbers are read from an MJCF file, see :mod:`viapoint.envs.arms.mjcf`.
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
        """See :attr:`viapoint.envs.arms.arm.Arm.link_radii`."""
        return tuple(link.radius for link in self.shape)

    @property
    def traced(self) -> tuple[str, ...]:
        """See :attr:`viapoint.envs.arms.arm.Arm.traced`."""
        return (self.hand_site, *(f"{link.name}_{end}" for link in self.shape for end in (0, 1)))

    def compile(self, n_obstacles: int, whole_arm: bool) -> mujoco.MjModel:
        """See :meth:`viapoint.envs.arms.arm.Arm.compile`."""
        spec = read_spec(self.model_file)
        self._add_links(spec, whole_arm)
        self._add_actuators(spec)
        add_obstacles(spec, n_obstacles)
        return spec.compile()

    def hand(self, joints: Array) -> Array:
        """See :meth:`viapoint.envs.arms.arm.Arm.hand`."""
        return self.chain.points(joints, ((len(self.joint_range) - 1, self.hand_at),))[..., 0, :]

    def links(self, joints: Array) -> Array:
        """See :meth:`viapoint.envs.arms.arm.Arm.links`."""
        xp = namespace_of(joints)
        places = tuple((link.joint, end) for link in self.shape for end in link.ends)
        points = self.chain.points(joints, places)
        return xp.reshape(points, (*joints.shape[:-1], len(self.shape), 2, 3))

    def posture(self, hand: Array) -> Array:
        """See :meth:`viapoint.envs.arms.arm.Arm.posture`."""
        return self.place(hand)

    def reach_margin(self, hand: Array) -> Array:
        """See :meth:`viapoint.envs.arms.arm.Arm.reach_margin`."""
        return self.place.margin(hand)

    def pace(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """See :meth:`viapoint.envs.arms.arm.Arm.pace`.

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
        """See :meth:`viapoint.envs.arms.arm.Arm.controls`.

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
