"""Executed movements to draw, and their first contacts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.common.arrays import in_space
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.geometry.distance import arm_clearance, hand_clearance, point_distance_squared
from viapoint.envs.geometry.rows import has_shapes, pair_distance
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.outcome import Rollout

CONTACT_TOLERANCE = 0.01
"""Greatest clearance of an obstacle that counts as the one in contact, [m]."""


class FirstContact(NamedTuple):
    """First contact of a movement."""

    step: int
    """Physics step: the index into the movement of the state in contact."""
    obstacle: int
    """Row of the obstacle; -1 if the arm touched itself or the table."""
    link: int | None
    """Index of the link, or None for the hand."""
    position: Float
    """Nearest point of the hand or of the link's axis, shape (D,), [m]."""


class Movement(NamedTuple):
    """Movement to draw: its states from the start on, one more than physics steps."""

    planned: Float
    """Planned path of the hand, shape (T + 1, D), [m]."""
    vias: Float
    """Via-points, shape (K, D), [m]."""
    joints: Float
    """Joint angles, shape (T + 1, J), [rad]."""
    hand: Float
    """Executed path of the hand, shape (T + 1, D), [m]."""
    contact: FirstContact | None
    """First contact, if any."""

    @classmethod
    def of(cls, collision_model: CollisionModel, scene: Scenes, plan: Plan, rollout: Rollout) -> Movement:
        """Return the movement of a plan in a scene; both have one row."""
        arm = collision_model.arm
        joints = np.concatenate((np.asarray(arm.inverse_kinematics(scene.start)), rollout.joints))
        return cls(
            planned=np.concatenate((scene.start, rollout.planned)),
            vias=np.asarray(plan.waypoints).reshape(-1, arm.dimension)[1:-1],
            joints=joints,
            hand=np.concatenate((scene.start, rollout.hand)),
            contact=first_contact(collision_model, scene, joints, rollout.contact),
        )


def first_contact(
    collision_model: CollisionModel, scene: Scenes, joints: Float, contact: Bool
) -> FirstContact | None:
    """Return the first contact: the nearest body and obstacle at the first step at which the simulation reports one."""
    if not contact.any():
        return None
    arm, step = collision_model.arm, int(contact.argmax())
    joints = joints[None, step : step + 1]
    hand, links = (np.asarray(each(joints)) for each in (arm.hand_position, arm.links))
    obstacles = scene.obstacles, scene.present
    bodies = [hand_clearance(hand, arm.hand_radius, *obstacles)]
    if collision_model.whole_arm:
        each = enumerate(arm.link_radii)
        bodies += [arm_clearance(links[..., i : i + 1, :, :], (radius,), *obstacles) for i, radius in each]
    clearance = np.concatenate(bodies)
    if not clearance.size or clearance.min() > CONTACT_TOLERANCE:
        return FirstContact(step, -1, None, hand[0, 0])
    body, obstacle = (int(i) for i in np.unravel_index(clearance.argmin(), clearance.shape))
    ends = links[0, 0, body - 1] if body else hand[0]
    points = ends[0] + np.linspace(0.0, 1.0, 200)[:, None] * (ends[-1] - ends[0])
    row = scene.obstacles[0, obstacle : obstacle + 1]
    if has_shapes(row):
        nearest = pair_distance(np.tile(row, (len(points), 1)), in_space(points)).argmin()
    else:
        nearest = point_distance_squared(points, row).argmin()
    return FirstContact(step, obstacle, body - 1 if body else None, points[nearest])
