"""What came of a movement."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import Arm, CollisionModel
from viapoint.envs.common.arrays import norm, squared_length
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.geometry.narrow_phase import nearest_approach
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.sim.simulator import SimulationLog

GOAL_TOLERANCE = 0.01
"""Greatest distance from the goal that counts as success, [m]."""
REST_SPEED = 0.02
"""Greatest hand speed at the end that counts as rest, [m/s]."""
LIMIT_TOLERANCE = 1e-3
"""How far MuJoCo's soft limits may give way, [rad]."""


class Outcome(NamedTuple):
    """What came of N movements, shape (N,) each."""

    is_success: Bool
    """No contact, joint limits kept, at rest within 1 cm of the goal after the settling time."""
    collision: Bool
    """Contact at any physics step."""
    first_contact_time: Float
    """[s]; -1 without contact."""
    min_clearance: Float
    """[m], exact, over all physics steps; at most 1."""
    planned_clearance: Float
    """[m], of the plan: how deep it would cut into an obstacle that gave way; at most 1."""
    goal_error: Float
    """[m], after the settling time."""
    duration: Float
    """[s], planned, and stretched where the arm's limits ask for it."""
    path_length: Float
    """[m], of the hand."""
    jerk_cost: Float
    """Half the integral of the planned squared jerk, [m^2/s^5]."""
    jerk_ratio: Float
    """Jerk cost relative to the straight movement's of the same duration."""
    peak_speed: Float
    """[m/s], of the hand."""
    tracking_error: Float
    """[m], root mean square of hand minus plan."""
    reachable: Bool
    """Whether the whole plan is within the arm's reach; if not, the arm does not start."""
    unstable: Bool
    """Whether the physics broke down."""
    stretch: Float
    """By which factor the movement was slowed down for the arm's limits; 1 where it was not."""


def measure(
    record: SimulationLog,
    steps: NDArray[np.int64],
    planned: Float,
    scenes: Scenes,
    collision_model: CollisionModel,
    *,
    timestep: float,
) -> Outcome:
    """The outcome of n movements that were carried out, all but what the plan alone decides.

    Args:
        record: Of T physics steps.
        steps: How many of them belong to each movement, shape (n,).
        planned: Hand position of the plan after each step, shape (n, T, D), [m].
        scenes: Where they took place.
        collision_model: Arm that moved.
        timestep: Of the physics, [s].
    """
    arm = collision_model.arm
    after = np.arange(record.joints.shape[1]) >= steps[:, None]
    last = np.arange(len(steps)), steps - 1
    joints, contact = record.joints, record.contact
    if after.any():
        joints, contact = np.where(after[..., None], joints[last][:, None], joints), contact & ~after
    hand = _hand(record, joints, after, last, arm)
    moved = norm(np.diff(hand, axis=1, prepend=scenes.start[:, None]))
    deviation = np.where(after, 0.0, squared_length(hand - planned))
    low, high = (np.array(side) for side in zip(*arm.joint_range, strict=True))
    within = (joints >= low - LIMIT_TOLERANCE) & (joints <= high + LIMIT_TOLERANCE)
    goal_error = norm(hand[last] - scenes.goal)
    collision: Any = contact.any(axis=-1)
    at_rest = moved[last] < REST_SPEED * timestep
    arrived = at_rest & (goal_error < GOAL_TOLERANCE)
    return empty_outcome(len(steps))._replace(
        is_success=arrived & ~collision & ~record.unstable & within.all(axis=(1, 2)),
        collision=collision,
        first_contact_time=np.where(collision, contact.argmax(axis=-1) * timestep, -1.0),
        min_clearance=_measured_clearance(record, hand, joints, last, scenes, collision_model),
        goal_error=goal_error,
        path_length=_sum_in_order(moved),
        peak_speed=moved.max(axis=-1) / timestep,
        tracking_error=np.sqrt(_sum_in_order(deviation) / steps),
        reachable=np.ones(len(steps), dtype=bool),
        unstable=record.unstable,
    )


def _hand(record: SimulationLog, joints: Float, after: Bool, last: tuple[Any, Any], arm: Arm) -> Float:
    """Where the hand was after each step: computed, or as the physics has recorded it, which it does before each."""
    if record.traced is None:
        return np.asarray(arm.hand_position(joints))
    hand = np.empty((*joints.shape[:2], 3))
    hand[:, :-1] = record.traced.places[:, 1:, record.traced.hand]
    hand[last] = arm.hand_position(joints[last])
    if after.any():
        hand = np.where(after[..., None], hand[last][:, None], hand)
    return hand


def _measured_clearance(
    record: SimulationLog,
    hand: Float,
    joints: Float,
    last: tuple[Any, Any],
    scenes: Scenes,
    collision_model: CollisionModel,
) -> Float:
    """Least clearance over all steps; of what the physics has recorded, before each of them."""
    if record.traced is None or not collision_model.whole_arm:
        return collision_model.least_clearance(hand, scenes.obstacles, scenes.present, joints)
    radii = collision_model.arm.link_radii
    return nearest_approach(record.traced, radii, scenes.obstacles, scenes.present, last[1])


def add_terminal_metrics(
    outcome: Outcome, joints: Float, scenes: Scenes, collision_model: CollisionModel
) -> Outcome:
    """The outcome of N movements with what belongs to where the arms ended, looked at for all of them together.

    Where their places are recorded before each step, the clearance after the last one is missing. And arms whose plans
    were out of reach have stayed at rest at the start.

    Args:
        outcome: Of which this is missing.
        joints: Where the arms ended, shape (N, J), [rad].
        scenes: Where they moved.
        collision_model: Arm that moved.
    """
    some = np.flatnonzero(
        ~outcome.reachable | (collision_model.whole_arm and len(collision_model.arm.traced) > 0)
    )
    least, scene = outcome.min_clearance.copy(), scenes.take(some)
    # Where links are traced, the hand is the end of one of them.
    least[some] = np.minimum(
        np.where(outcome.reachable, least, MAX_CLEARANCE)[some],
        collision_model.least_clearance(
            scene.start[:, None], scene.obstacles, scene.present, joints[some, None]
        ),
    )
    away = norm(scenes.goal - scenes.start)
    goal_error = np.where(outcome.reachable, outcome.goal_error, away)
    return outcome._replace(min_clearance=least, goal_error=goal_error)


def empty_outcome(number: int) -> Outcome:
    """`number` movements of which nothing is known."""
    fields: dict[str, Any] = {name: np.zeros(number) for name in Outcome._fields}
    for name in ("is_success", "collision", "reachable", "unstable"):
        fields[name] = np.zeros(number, dtype=bool)
    return Outcome(**{**fields, "first_contact_time": np.full(number, -1.0), "stretch": np.ones(number)})


def _sum_in_order(values: Float) -> Float:
    """Sum along the last axis, one after the other, so that zeros behind change no bit of it."""
    return np.asarray(np.cumsum(values, axis=-1)[..., -1])
