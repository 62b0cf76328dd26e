"""Planar arm with two joints, shoulder and elbow, in the horizontal plane."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from viapoint.envs.arms.mjcf import add_obstacles, read_spec
from viapoint.envs.common.types import Array, Box
from viapoint.envs.geometry.distance import MAX_CLEARANCE


@dataclass(frozen=True, kw_only=True)
class PlanarArm:
    """Arm of two links in the plane; see :class:`~viapoint.envs.arms.base.Arm` for its functions.

    The elbow bends one way only, so each hand position has one configuration. All numbers come from the MJCF file,
    which names their sources.

    Example:
        >>> import numpy as np
        >>> from viapoint.envs.arms import ADULT
        >>> joints = ADULT.inverse_kinematics(np.array([0.1, 0.4]))
        >>> np.degrees(joints).round(1).tolist()  # shoulder, elbow
        [20.8, 104.9]
        >>> ADULT.hand_position(joints).round(6).tolist()
        [0.1, 0.4]
        >>> ADULT.links(joints).round(2).tolist()  # both ends of upper arm and forearm
        [[[0.0, 0.0], [0.3, 0.12]], [[0.3, 0.12], [0.1, 0.4]]]
    """

    name: str
    model_file: str
    lengths: tuple[float, float]
    """Distances from shoulder to elbow and from elbow to hand, [m]."""
    masses: tuple[float, float]
    """Masses of the two links, [kg]."""
    centres: tuple[float, float]
    """Distances from each link's proximal joint to its centre of mass, [m]."""
    inertias: tuple[float, float]
    """Inertias about each link's centre of mass, [kg m^2]."""
    viscosity: tuple[float, float]
    """Viscous friction of the joints, [N m s/rad]."""
    torque_limit: tuple[float, float]
    """Greatest torques, [N m]."""
    joint_range: tuple[tuple[float, float], ...]
    hand_radius: float
    link_radii: tuple[float, ...]
    workspace: Box = ((-0.45, 0.15), (0.35, 0.60))
    bandwidth: float = 40.0
    """Natural frequency of the critically damped joint servos, [rad/s]."""
    dimension: int = 2
    traced: tuple[str, ...] = ()
    velocity_limit: tuple[float, ...] = ()
    link_joints: tuple[int, ...] = (0, 1)

    @classmethod
    def from_file(cls, model_file: str) -> PlanarArm:
        """Return the arm of an MJCF file among the package's `assets`."""
        model = read_spec(model_file).compile()
        joints = [model.joint(name) for name in ("shoulder", "elbow")]
        links = [model.body(name) for name in ("upper_arm", "forearm")]
        return cls(
            name=model_file.removesuffix(".xml"),
            model_file=model_file,
            lengths=(float(links[1].pos[0]), float(model.site("hand").pos[0])),
            masses=_pair(link.mass[0] for link in links),
            centres=_pair(link.ipos[0] for link in links),
            inertias=_pair(link.inertia[2] for link in links),
            viscosity=_pair(joint.damping[0] for joint in joints),
            torque_limit=_pair(model.actuator(name).forcerange[1] for name in ("shoulder", "elbow")),
            joint_range=tuple((float(j.range[0]), float(j.range[1])) for j in joints),
            hand_radius=float(model.geom("hand").size[0]),
            link_radii=_pair(model.geom(name).size[0] for name in ("upper_arm", "forearm")),
        )

    @functools.cached_property
    def _inertia(self) -> tuple[float, float, float]:
        """Constants A, B, C of the mass matrix [[A + 2 B cos, C + B cos], [C + B cos, C]], [kg m^2]."""
        (m1, m2), (r1, r2), (i1, i2) = self.masses, self.centres, self.inertias
        elbow = i2 + m2 * r2**2
        return i1 + m1 * r1**2 + m2 * self.lengths[0] ** 2 + elbow, m2 * self.lengths[0] * r2, elbow

    @functools.cached_property
    def stiffness(self) -> tuple[float, float]:
        """Stiffness of the joint servos, [N m/rad], for the arm stretched out, where its inertia is greatest."""
        a, b, c = self._inertia
        return (a + 2.0 * b) * self.bandwidth**2, c * self.bandwidth**2

    @functools.cached_property
    def damping(self) -> tuple[float, float]:
        """Damping of the joint servos, [N m s/rad]; with the joints' viscosity it is critical."""
        return _pair(
            2.0 * k / self.bandwidth - v for k, v in zip(self.stiffness, self.viscosity, strict=True)
        )

    @functools.cached_property
    def reach(self) -> tuple[float, float]:
        """Least and greatest distance of the hand from the shoulder, [m]."""
        low, high = self.joint_range[1]
        upper, fore = self.lengths
        near, far = (upper**2 + fore**2 + 2 * upper * fore * np.cos([high, low])) ** 0.5
        return float(near), float(far)

    def compile(self, n_obstacles: int, whole_arm: bool, meshes: Sequence[str] = ()) -> mujoco.MjModel:
        """Return the MuJoCo model; see :meth:`viapoint.envs.arms.base.Arm.compile`."""
        spec = read_spec(self.model_file)
        if whole_arm:
            _lower_into_plane(spec)
        for actuator, stiffness, damping in zip(spec.actuators, self.stiffness, self.damping, strict=True):
            actuator.biasprm[1:3] = -stiffness, -damping
        for geom in (spec.geom("upper_arm"), spec.geom("forearm")):
            geom.contype = int(whole_arm)
        add_obstacles(spec, n_obstacles, meshes)
        return spec.compile()

    def hand_position(self, joints: Array) -> Array:
        """Return hand positions; see :meth:`viapoint.envs.arms.base.Arm.hand_position`."""
        upper, both = joints[..., 0], joints[..., 0] + joints[..., 1]
        l1, l2 = self.lengths
        return np.stack(
            (l1 * np.cos(upper) + l2 * np.cos(both), l1 * np.sin(upper) + l2 * np.sin(both)), axis=-1
        )

    def links(self, joints: Array) -> Array:
        """Return link segments; see :meth:`viapoint.envs.arms.base.Arm.links`."""
        upper, hand = joints[..., 0], self.hand_position(joints)
        elbow = (self.lengths[0] * np.cos(upper), self.lengths[0] * np.sin(upper))
        zero = np.zeros_like(upper)
        ends = np.stack((zero, zero, *elbow, *elbow, hand[..., 0], hand[..., 1]))
        return _batch_first(np.reshape(ends, (2, 2, 2, *zero.shape)), 3)

    def self_clearance(self, joints: Array) -> Array:
        """Return MAX_CLEARANCE: adjacent links may touch; see :meth:`viapoint.envs.arms.base.Arm.self_clearance`."""
        return np.full_like(joints[..., 0], MAX_CLEARANCE)

    def links_at(self, hand: Array) -> tuple[tuple[Array, Array], ...]:
        """Return both ends of each link for the hand at `hand`, shape (..., 2), [m], without computing angles.

        Within reach the result equals that of :meth:`links` up to rounding. Out of reach, the forearm still ends at the
        hand, longer or shorter than it is. Joint angles cost more: 1.7 times the time in single precision, 17 times in
        double precision (1,280 positions in each of 64 scenes).
        """
        (c1, s1), _ = self._directions(hand)
        square = c1 * c1 + s1 * s1
        # With the hand at the shoulder every direction is a solution: take that of the inverse kinematics.
        c1, square = (np.where(square > 0.0, each, 1.0) for each in (c1, square))
        upper = self.lengths[0] / np.sqrt(square)
        elbow = _batch_first(np.stack((c1 * upper, s1 * upper)))
        return (np.zeros_like(elbow), elbow), (elbow, hand)

    def inverse_kinematics(self, hand: Array) -> Array:
        """Return joint angles; see :meth:`viapoint.envs.arms.base.Arm.inverse_kinematics`.

        Out of reach, the elbow is as straight or as bent as it can be.
        """
        return self._configurations(hand)[0]

    def reach_margin(self, hand: Array) -> Any:
        """Return the distance inside the reach; see :meth:`viapoint.envs.arms.base.Arm.reach_margin`.

        It is the least of the distances to the inner and the outer circle and, along arcs, to the shoulder's limits.
        """
        distance = np.sqrt(hand[..., 0] ** 2 + hand[..., 1] ** 2)
        near, far = self.reach
        low, high = self.joint_range[0]
        (cosine, sine), _ = self._directions(hand)
        shoulder = np.atan2(sine, cosine)
        arc = np.minimum(shoulder - low, high - shoulder) * distance
        return np.minimum(np.minimum(distance - near, far - distance), arc)

    def required_time_scale(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return 1: human joints have no velocity limit; see :meth:`viapoint.envs.arms.base.Arm.required_time_scale`.

        The simulation enforces the torque limits, which random movements reach twice in ten thousand.
        """
        return np.ones_like(position[..., 0, 0])

    def controls(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return computed-torque controls; see :meth:`viapoint.envs.arms.base.Arm.controls`.

        The actuator's torque is control - stiffness * angle - damping * velocity, limited to `torque_limit`. So the
        control is the torque of the inverse dynamics plus stiffness and damping times the references, [N m].
        """
        joints, upper_arm, forearm, sine = self._configurations(position)
        rates = self._rates(position, forearm, sine, velocity)
        centripetal = (self.lengths[0] * rates[0] ** 2, self.lengths[1] * (rates[0] + rates[1]) ** 2)
        # Differentiating J q' = v gives J q'' = a - J' q', and -J' q' is the sum of centripetal terms along the links.
        relative = tuple(
            acceleration[..., i] + centripetal[0] * upper_arm[i] + centripetal[1] * forearm[i] for i in (0, 1)
        )
        accelerations = self._rates(position, forearm, sine, np.stack(relative, axis=-1))
        cosine = upper_arm[0] * forearm[0] + upper_arm[1] * forearm[1]
        torques = self._torques(cosine, sine, rates, accelerations)
        return np.stack(
            [
                torques[i]
                + self.stiffness[i] * joints[..., i]
                + (self.damping[i] + self.viscosity[i]) * rates[i]
                for i in (0, 1)
            ],
            axis=-1,
        )

    def _configurations(self, hand: Array) -> tuple[Array, tuple[Array, Array], tuple[Array, Array], Array]:
        """Return joint angles, unit vectors along upper arm and forearm, and the sine of the elbow's angle."""
        (c1, s1), (cosine, sine) = self._directions(hand)
        joints = _batch_first(np.stack((np.atan2(s1, c1), np.atan2(sine, cosine))))
        return joints, (c1, s1), (c1 * cosine - s1 * sine, s1 * cosine + c1 * sine), sine

    def _directions(self, hand: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Return cosine and sine of the shoulder's angle, and of the elbow's, by the law of cosines.

        The hand is at `along`, `across` in the frame of the upper arm; the shoulder turns that point to (x, y).
        """
        l1, l2 = self.lengths
        low, high = self.joint_range[1]
        x, y = hand[..., 0], hand[..., 1]
        cosine = (x * x + y * y - (l1**2 + l2**2)) * (0.5 / (l1 * l2))
        cosine = cosine.clip(float(np.cos(high)), float(np.cos(low)))
        sine = np.sqrt(1.0 - cosine * cosine)
        along, across = l1 + l2 * cosine, l2 * sine
        scale = 1.0 / (along * along + across * across)
        shoulder = (along * x + across * y) * scale, (along * y - across * x) * scale
        return shoulder, (cosine, sine)

    def _rates(
        self, hand: Array, forearm: tuple[Array, Array], sine: Array, rate: Array
    ) -> tuple[Array, Array]:
        """Return the joint rates that give the hand `rate`: the inverse Jacobian times `rate`."""
        l1, l2 = self.lengths
        scale = 1.0 / (l1 * sine)
        shoulder = (forearm[0] * rate[..., 0] + forearm[1] * rate[..., 1]) * scale
        elbow = -(hand[..., 0] * rate[..., 0] + hand[..., 1] * rate[..., 1]) * (scale / l2)
        return shoulder, elbow

    def _torques(
        self,
        cosine: Array,
        sine: Array,
        rates: tuple[Array, Array],
        accelerations: tuple[Array, Array],
    ) -> tuple[Array, Array]:
        """Return the torques of the inverse dynamics of the two links without viscosity, [N m]."""
        a, b, c = self._inertia
        coupling = c + b * cosine
        coriolis = b * sine
        shoulder = (
            (a + 2.0 * b * cosine) * accelerations[0]
            + coupling * accelerations[1]
            - coriolis * rates[1] * (2.0 * rates[0] + rates[1])
        )
        elbow = coupling * accelerations[0] + c * accelerations[1] + coriolis * rates[0] ** 2
        return shoulder, elbow


def _pair(values: Any) -> tuple[float, float]:
    first, second = values
    return float(first), float(second)


def _batch_first(array: Array, axes: int = 1) -> Array:
    """Return a view with the first `axes` axes moved behind the batch."""
    return np.moveaxis(array, tuple(range(axes)), tuple(range(-axes, 0)))


def _lower_into_plane(spec: mujoco.MjSpec) -> None:
    """Move links and hand to the height of the obstacles, so that all of them collide."""
    spec.body("upper_arm").pos[2] = 0.0
    for handle in (spec.geom("hand"), spec.site("hand")):
        handle.pos[2] = 0.0


ADULT = PlanarArm.from_file("planar.xml")
"""Right arm of an adult, its shoulder at the origin, x to the right and y forwards."""
