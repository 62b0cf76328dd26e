"""Clearance, reach and reward of planned movements, computed without a simulation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.arms.base import Arm
from viapoint.envs.common.types import Index, Numbers, Single
from viapoint.envs.geometry.distance import MAX_CLEARANCE
from viapoint.envs.mdp.observation import is_replanning
from viapoint.envs.mdp.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT, weighted_terms
from viapoint.envs.sim.outcome import SETTLING
from viapoint.training.search.planned_clearance import (
    FRACTIONS,
    NODES,
    STEP_REACH,
    Obstacles,
    least_clearance,
    parabola_minimum,
)
from viapoint.training.search.planned_movements import (
    Observation,
    PlannedMovements,
    plan_movements,
    take_rows,
)

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task

CLEARANCE_MARGIN = 0.001
"""Least planned clearance of a movement that the search prefers, [m]; 1 to 8 mm make no difference."""
REACH_MARGIN = 0.001
"""Least reach margin of a movement that the search prefers, [m]."""
MIN_REFINED = -0.055
"""Clearance below which no instant is refined, [m]: the reward ends at CLEARANCE_RANGE."""
MAX_REFINED = 0.1
"""Clearance above which no instant is refined, [m]."""
INFEASIBLE = -1e6
"""Merit offset of plans outside the margins, below the merit of every plan within them."""
PATH_BLOCK = 1 << 17
"""Hand positions that are computed together before the best plans are checked."""
FIRST_BATCH = 64
"""Plans of each scene that are checked first; every further batch is twice as large."""
CHECK_BLOCK = 1 << 14
"""Hand positions that are checked together, so that temporary arrays stay in the cache."""


class PlanChecks(NamedTuple):
    """Checks of H planned movements in each of B scenes, shape (B, H) each."""

    clearance: Single
    """Least clearance over the movement, [m], at most MAX_CLEARANCE.

    Between MIN_REFINED and MAX_REFINED its error is below half a millimetre, if the movement stays within reach; among
    boxes it is up to 2 mm in one plan of fifty. Beyond them it is the least of NODES instants, and slightly too large;
    for other obstacles than capsules, above MAX_REFINED a lower bound.
    """
    reach_margin: Single
    """Least distance inside the arm's reach, [m]; negative where the movement leaves it."""
    reward: Single
    """Reward if the physics follows the plan."""


def check_plans(
    observation: Observation,
    actions: Numbers,
    task: Task,
    until: float = np.inf,
    *,
    max_refined: float = MAX_REFINED,
) -> PlanChecks:
    """Compute clearance, reach margin and reward of the plans of H actions in each of B scenes.

    Obstacles with velocities are extrapolated with them. The reward has the terms of
    :func:`~viapoint.envs.mdp.rewards.weighted_terms`. The goal error of a collision is unknown and counts as zero, and
    movements are not slowed down for the arm's limits. When replanning, the reward is that of the rest of the episode
    if nothing changes: success counts if the remaining time suffices, and the smoothness term weighs
    :attr:`~viapoint.training.search.planned_movements.PlannedMovements.effort`.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        until: Time after which clearance does not matter, [s].
        max_refined: Clearance above which no instant is refined, [m].
    """
    found = PlanChecks(*(np.empty(actions.shape[:2], np.float32) for _ in PlanChecks._fields))
    obstacles = Obstacles.from_observation(observation, task)
    for rows in _blocks(obstacles.number, max(1, CHECK_BLOCK // (actions.shape[1] * NODES))):
        some = take_rows(observation, rows)
        moves = plan_movements(some, actions[rows], task, FRACTIONS)
        clearance = least_clearance(moves, obstacles.take(rows), task, until, (MIN_REFINED, max_refined))
        reach = _least_reach_margin(task.arm, moves.path)
        found.clearance[rows], found.reach_margin[rows] = clearance, reach
        found.reward[rows] = _reward(some, moves, clearance, reach, task)
    return found


def merit(checks: PlanChecks, clearance_margin: float, reach_margin: float) -> NDArray[np.float64]:
    """Return the merit of plans, shape (B, H), by which the best one has the greatest.

    It is the reward of plans whose clearance and reach margin exceed the given margins, [m]. Others have a merit near
    INFEASIBLE; the minimum of clearance and reach margin orders them.
    """
    within = (checks.clearance > clearance_margin) & (checks.reach_margin > reach_margin)
    least = np.minimum(checks.clearance, checks.reach_margin, dtype=np.float64)
    return np.where(within, checks.reward, least + INFEASIBLE)


def pruned_merit(
    observation: Observation,
    actions: Numbers,
    task: Task,
    margins: tuple[float, float],
    until: float = np.inf,
    bonus: float = 0.0,
) -> NDArray[np.float64]:
    """Return :func:`merit` of the best plan of each scene by branch and bound, shape (B, H).

    Jerk, duration and reach bound the reward of a plan. So clearance is checked in the order of this bound, until no
    other plan can be better. Up to FIRST_BATCH plans are all checked.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        margins: Least clearance and least reach margin, [m].
        until: Time after which clearance does not matter, [s].
        bonus: Reward added to the first action.

    Returns:
        Merits, minus infinity for plans that are pruned or outside the margins. Up to FIRST_BATCH plans have the exact
        merit, within the margins or not.
    """
    if actions.shape[1] <= FIRST_BATCH:
        most = max(CLEARANCE_RANGE[1], *margins)  # beyond it merits do not depend on clearance
        merits = merit(check_plans(observation, actions, task, until, max_refined=most), *margins)
        merits[:, 0] += np.where(merits[:, 0] > 0.5 * INFEASIBLE, bonus, 0.0)
        return merits
    merits = np.full(actions.shape[:2], -np.inf)
    obstacles = Obstacles.from_observation(observation, task)
    for rows in _blocks(obstacles.number, max(1, PATH_BLOCK // (actions.shape[1] * NODES))):
        some = take_rows(observation, rows)
        moves, bound = reward_bounds(some, actions[rows], task, margins[1])
        bound[:, 0] += bonus
        merits[rows] = _branch_and_bound(moves, bound, obstacles.take(rows), task, margins[0], until)
    return merits


def reward_bounds(
    observation: Observation, actions: Numbers, task: Task, reach_margin: float
) -> tuple[PlannedMovements, Numbers]:
    """Return the plans of actions and upper bounds of their rewards, the rewards without obstacles, shape (B, H).

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        reach_margin: Least reach margin, [m]; plans below it have the bound minus infinity.
    """
    moves = plan_movements(observation, actions, task, FRACTIONS)
    reach = _least_reach_margin(task.arm, moves.path)
    bound = _reward(observation, moves, np.full_like(reach, MAX_CLEARANCE), reach, task)
    return moves, np.where(reach > reach_margin, bound, -np.inf)


def _branch_and_bound(
    moves: PlannedMovements, bound: Numbers, obstacles: Obstacles, task: Task, margin: float, until: float
) -> Numbers:
    """Return the merits of plans, shape (B, H), checked in the order of their upper bounds."""
    merits = np.full(bound.shape, -np.inf)
    order = np.argsort(-bound, axis=-1, kind="stable")
    open_scenes, first, count = np.arange(len(bound)), 0, FIRST_BATCH
    while open_scenes.size and first < bound.shape[1]:
        these = open_scenes[:, None], order[open_scenes, first : first + count]
        some = PlannedMovements(*(field[these] for field in moves))
        exact = margin, max(CLEARANCE_RANGE[1], margin)  # beyond it merits do not depend on clearance
        clearance = least_clearance(some, obstacles.take(open_scenes), task, until, exact)
        lost = np.clip(clearance, *CLEARANCE_RANGE) - CLEARANCE_RANGE[1]
        reward = bound[these] + task.weights.clearance * lost / CLEARANCE_UNIT
        merits[these] = np.where(clearance > margin, reward, -np.inf)
        first, count = first + count, 2 * count
        if first < bound.shape[1]:
            following = bound[open_scenes, order[open_scenes, first]]
            open_scenes = open_scenes[(merits[open_scenes].max(axis=-1) < following) & (following > -np.inf)]
    return merits


def _blocks(number: Index, size: int) -> Iterator[Any]:
    """Yield the indices of scenes that are checked together; scenes of a block have similar numbers of obstacles."""
    if len(number) <= size:
        yield slice(None)
        return
    order = np.argsort(number, kind="stable")
    yield from (order[first : first + size] for first in range(0, len(order), size))


def _least_reach_margin(arm: Arm, path: Numbers) -> Numbers:
    """Return the least reach margin over movements, shape (B, H), [m], between instants by parabolas."""
    margin = np.asarray(arm.reach_margin(path))
    inner = parabola_minimum(margin[..., :-2], margin[..., 1:-1], margin[..., 2:], STEP_REACH).min(axis=-1)
    return np.asarray(np.minimum(inner, np.minimum(margin[..., 0], margin[..., -1])))


def _reward(
    observation: Observation, moves: PlannedMovements, clearance: Numbers, reach: Numbers, task: Task
) -> Numbers:
    """Return the reward of movements that go as planned, shape (B, H)."""
    reachable, touches = reach >= 0.0, clearance < 0.0
    success = (reachable & ~touches).astype(np.float32)
    if is_replanning(observation):
        # After its end a movement settles for SETTLING. Success fades in over as much spare time again.
        spare = observation["time_left"] - moves.duration
        success *= np.clip(spare / SETTLING - 1.0, 0.0, 1.0)
    line = observation["goal"] - observation["hand"]
    goal_error = np.where(reachable, 0.0, np.sqrt((line * line).sum(axis=-1, keepdims=True)))
    relative = moves.duration / task.action.centre_duration
    return weighted_terms(
        success, reachable & touches, clearance, goal_error, moves.effort, relative, task.weights
    ).total()
