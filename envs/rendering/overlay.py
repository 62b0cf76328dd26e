"""A movement as it is drawn, and what it touched."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.types import Float
from viapoint.envs.geometry.distance import arm_clearance, hand_clearance, point_distance_squared
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.executor import Rollout

TOUCHING = 0.01
"""Clearance up to which an obstacle is what was touched, [m]."""


class Touch(NamedTuple):
    """What touched what, and when."""

    step: int
    """Physics step of the first contact: the index into a rollout of the state in which they touched."""
    obstacle: int
    """Row of the obstacle; -1 where the arm touched itself or the table."""
    link: int | None
    """Index of the link; None is the hand."""
    place: Float
    """Where on the hand or on the link's axis, shape (D,), [m]."""


class Movement(NamedTuple):
    """A movement as it is drawn: its states from the start on, one more than physics steps."""

    planned: Float
    """Hand path of the plan, shape (T + 1, D), [m]."""
    vias: Float
    """Shape (K, D), [m]."""
    joints: Float
    """Shape (T + 1, J), [rad]."""
    hand: Float
    """Shape (T + 1, D), [m]."""
    touch: Touch | None
    """The first contact."""

    @classmethod
    def of(cls, collision_model: CollisionModel, scene: Scenes, plan: Plan, rollout: Rollout) -> Movement:
        """The movement of one plan in one scene; both have one row."""
        arm = collision_model.arm
        start = np.asarray(arm.inverse_kinematics(scene.start))
        joints = np.concatenate((start, rollout.joints))
        return cls(
            planned=np.concatenate((scene.start, rollout.planned)),
            vias=np.asarray(plan.waypoints).reshape(-1, arm.dimension)[1:-1],
            joints=joints,
            hand=np.concatenate((scene.start, rollout.hand)),
            touch=first_touch(collision_model, scene, joints, rollout.contact),
        )


def first_touch(
    collision_model: CollisionModel, scene: Scenes, joints: Float, contact: NDArray[np.bool_]
) -> Touch | None:
    """What the arm touched first: the nearest part and obstacle where the physics first reports contact."""
    if not contact.any():
        return None
    arm, step = collision_model.arm, int(contact.argmax())
    posture = joints[None, step : step + 1]
    rows, present = scene.obstacles, scene.present
    parts = [hand_clearance(np.asarray(arm.hand_position(posture)), arm.hand_radius, rows, present)]
    if collision_model.whole_arm:
        links = np.asarray(arm.links(posture))
        for i, radius in enumerate(arm.link_radii):
            parts.append(arm_clearance(links[..., i : i + 1, :, :], (radius,), rows, present))
    if not rows.shape[1] or min(float(each.min()) for each in parts) > TOUCHING:
        return Touch(step, -1, None, np.asarray(arm.hand_position(posture))[0, 0])
    part, obstacle = np.unravel_index(np.argmin(np.stack(parts)[:, 0]), (len(parts), rows.shape[1]))
    link = int(part) - 1 if part else None
    ends = (
        np.asarray(arm.hand_position(posture))[0]
        if link is None
        else np.asarray(arm.links(posture))[0, 0, link]
    )
    places = ends[0] + np.linspace(0.0, 1.0, 200)[:, None] * (ends[-1] - ends[0])
    nearest = point_distance_squared(places, rows[0, obstacle : obstacle + 1]).argmin()
    return Touch(step, int(obstacle), link, places[nearest])
