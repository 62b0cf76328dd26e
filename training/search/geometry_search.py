"""Search for a movement with computed geometry, without a network and without simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.types import Float, Numbers, Single
from viapoint.envs.common.validation import whole_number
from viapoint.envs.geometry.rows import CAPSULES, obstacle_names, obstacle_rows, row_size, widened
from viapoint.envs.geometry.shape import Shape
from viapoint.envs.mdp.observation import is_replanning
from viapoint.envs.registration import check_registered
from viapoint.envs.scenes.scene import Scenes, problems
from viapoint.training.search.candidates import candidate_actions, sobol_actions
from viapoint.training.search.plan_checks import (
    CLEARANCE_MARGIN,
    INFEASIBLE,
    REACH_MARGIN,
    check_plans,
    merit,
    pruned_merit,
)
from viapoint.training.search.planned_movements import Observation, take_rows

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task

N_CENTRES = 4
"""Number of best candidates that a round of refinement samples around."""
KEEP_BONUS = 0.1
"""Reward by which another plan must be better than the present one, as each change of plan costs jerk."""
HORIZONS = (1.2, 0.9, 0.6, 0.3)
"""Times for which a plan is checked where none is clear to its end, [s]: obstacles may change course."""
HORIZON_PENALTY = 1e3
"""Merit lost with each shorter horizon, more than any reward."""
SPREAD = 0.25
"""Half the side of the cube that the first round samples around each centre; each further round halves it."""


class GeometrySearch:
    """Planner that checks a fixed set of actions with computed geometry and takes the best one.

    The candidates are the zero action and the points of a Sobol sequence, the same ones in every scene. Their plans
    are ordered by :func:`~viapoint.training.search.plan_checks.merit`. Where nothing moves, clearance does not
    depend on the duration; then all candidates but the first have the duration of the greatest reward. Candidates
    that jerk, duration or reach rule out count as checked, though their clearance is not computed.

    When replanning, the present plan is kept as long as it is clear and no other plan is better by KEEP_BONUS. Where no
    plan is clear to its end, the search takes one that is clear for the longest of HORIZONS.

    Args:
        task: Task of an environment, or id of a registered environment.
        n_checks: Candidates checked before any refinement, 1 or more.
        refinements: Rounds in which `per_round` more candidates are checked around the best ones.
        per_round: Candidates of each round.
        clearance_margin: Clearance that the chosen plan exceeds if any candidate does, [m].
        reach_margin: Reach margin that the chosen plan exceeds if any candidate does, [m].
        **kwargs: Arguments of the environment, if an id is given.

    Raises:
        ValueError: A number is out of range.

    Example:
        >>> from viapoint.training import GeometrySearch
        >>> search = GeometrySearch("viapoint/PlanarObstacles-v0", n_checks=64)
        >>> plan = search.plan((-0.2, 0.3), (0.1, 0.4), obstacles=[(-0.05, 0.35, 0.0, 0.0, 0.03)])
        >>> plan.waypoints.shape, plan.durations.shape
        ((3, 2), (2,))
    """

    def __init__(
        self,
        task: Task | str,
        n_checks: int = 512,
        *,
        refinements: int = 0,
        per_round: int = 64,
        clearance_margin: float = CLEARANCE_MARGIN,
        reach_margin: float = REACH_MARGIN,
        **kwargs: Any,
    ) -> None:
        self.task = registered_task(task, **kwargs) if isinstance(task, str) else task
        self.n_checks = whole_number("n_checks", n_checks, 1)
        self.refinements = whole_number("refinements", refinements, 0)
        self.per_round = whole_number("per_round", per_round, 1)
        self._margins = float(clearance_margin), float(reach_margin)

    @property
    def total_checks(self) -> int:
        """Number of candidates that are checked for one decision."""
        return self.n_checks + self.refinements * self.per_round

    @property
    def name(self) -> str:
        """Name in tables of results."""
        return f"search, {self.total_checks} checks"

    def decide(self, observation: Observation, scenes: Any = None) -> Float:
        """Return the best action of each of B observations, shape (B, m).

        Args:
            observation: Parts of shape (B, .) each.
            scenes: Unused; part of the protocol :class:`~viapoint.training.planners.baselines.Method`.
        """
        number = len(observation["hand"])
        replanning = is_replanning(observation)
        actions = candidate_actions(self.task, self.n_checks, replanning=replanning)
        candidates = np.broadcast_to(actions, (number, *actions.shape))
        best, merits = best_actions(
            candidates, score_plans(observation, candidates, self.task, self._margins)
        )
        for each in range(self.refinements):
            steps = SPREAD * 0.5**each * self._steps(replanning)
            centres = best[:, np.arange(self.per_round) % best.shape[1]]
            near = np.clip(centres + steps, -1.0, 1.0)
            merits = np.concatenate(
                (merits, score_plans(observation, near, self.task, self._margins)), axis=1
            )
            best, merits = best_actions(np.concatenate((best, near), axis=1), merits)
        return best[:, 0].astype(np.float64)

    def predict(
        self,
        observation: Mapping[str, Any],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Single, None]:
        """Return the best action of one observation, shape (m,), or of a batch, shape (B, m), and no state.

        The signature is that of Stable-Baselines3's `predict`; only the observation is used.
        """
        parts = {name: np.asarray(part) for name, part in observation.items()}
        if parts["hand"].ndim > 1:
            return self.decide(parts).astype(np.float32), None
        return self.decide({name: part[None] for name, part in parts.items()})[0].astype(np.float32), None

    def plan(
        self, start: ArrayLike, goal: ArrayLike, obstacles: ArrayLike | Sequence[Shape] | None = None
    ) -> Plan:
        """Return the best plan from rest at `start` to rest at `goal` among obstacles that stand still.

        Where no candidate stays clear and in reach, the plan is the one with the least violation.

        Args:
            start: Hand position, shape (D,), [m].
            goal: Goal position, shape (D,), [m].
            obstacles: Rows of centre (D), half-axis (D) and radius, shape (n, 2 D + 1), [m]; or a list of shapes of
                :mod:`viapoint.envs` that scenes of the task may have; None for none.

        Raises:
            ValueError: An argument has another shape or is not finite, an end is out of reach or touches an obstacle,
                or an obstacle is too large.
        """
        scene = scene_from_rest(self.task, start, goal, obstacles)
        observation: dict[str, Float] = {"hand": scene.start, "goal": scene.goal}
        if scene.obstacles.size:
            observation["obstacles"] = self.task.observation.observed_obstacles(scene)
        return self.task.action.decode(self.decide(observation), scene.start, scene.goal).take(0)

    def _steps(self, replanning: bool) -> Single:
        """Return steps of a round of refinement, shape (per_round, m); from rest the duration stays as it is."""
        task, at = self.task, self.task.action.n_via * self.task.action.dimension
        if replanning or not at:
            return sobol_actions(self.per_round + 1, task.action.size)[1:]
        return np.insert(sobol_actions(self.per_round + 1, task.action.size - 1)[1:], at, 0.0, axis=1)


def score_plans(
    observation: Observation, actions: Numbers, task: Task, margins: tuple[float, float]
) -> Float:
    """Return the merit of actions, shape (B, H); minus infinity where another action is certainly no worse.

    When replanning, a first action of zero, which keeps the plan, gains KEEP_BONUS; where no plan is clear to its end,
    plans are compared by how long they stay clear.

    Args:
        observation: Parts of B observations, shape (B, .) each.
        actions: Shape (B, H, m), in [-1, 1].
        task: Task of the environment.
        margins: Least clearance and least reach margin, [m].
    """
    replanning = is_replanning(observation)
    bonus = KEEP_BONUS if replanning and not actions[:, 0].any() else 0.0
    merits = pruned_merit(observation, actions, task, margins, bonus=bonus)
    for rank, horizon in enumerate(HORIZONS if replanning else (), start=1):
        rows = np.flatnonzero(merits.max(axis=-1) < 0.5 * INFEASIBLE)
        if rows.size:
            some = take_rows(observation, rows)
            shorter = pruned_merit(some, actions[rows], task, margins, horizon, bonus)
            solved = shorter.max(axis=-1) > 0.5 * INFEASIBLE
            merits[rows[solved]] = shorter[solved] - rank * HORIZON_PENALTY
    rows = np.flatnonzero(np.isneginf(merits).all(axis=-1))
    if rows.size:  # nothing is within the margins: order all plans by their violation
        merits[rows] = merit(check_plans(take_rows(observation, rows), actions[rows], task), *margins)
    return merits


def scene_from_rest(
    task: Task, start: ArrayLike, goal: ArrayLike, obstacles: ArrayLike | Sequence[Shape] | None = None
) -> Scenes:
    """Return one scene with a start, a goal and obstacles that stand still; see :meth:`GeometrySearch.plan`.

    Raises:
        ValueError: An argument has another shape or is not finite, or the scene is impossible.
    """
    d = task.arm.dimension
    first, last = numbers_of_shape("start", start, (d,))[None], numbers_of_shape("goal", goal, (d,))[None]
    shapes = task.scenes.shapes
    obstacles = [] if obstacles is None else obstacles
    given = obstacle_rows(obstacles, d, shapes)
    capsules = np.shape(given)[-1:] == (row_size(d),)
    size = row_size(d) if capsules else row_size(d, shapes)
    rows = numbers_of_shape("obstacles", given if np.size(given) else np.zeros((0, size)), (None, size))
    scene = Scenes(first, last, (rows if shapes == CAPSULES else widened(rows))[None])
    for wrong, reason in problems(scene, task.collision_model, obstacle_names(obstacles)):
        if wrong.any():
            raise ValueError(reason(0))
    return scene


def registered_task(env_id: str, **kwargs: Any) -> Task:
    """Return the task of a registered environment made with `kwargs`."""
    check_registered(env_id)
    env: Any = gym.make_vec(env_id, num_envs=1, **kwargs)
    task: Task = env.unwrapped.task
    env.close()
    return task


def best_actions(actions: Numbers, merits: Numbers) -> tuple[Single, Numbers]:
    """Return the N_CENTRES best of H actions in each of B scenes, shape (B, N_CENTRES, m), and their merits.

    The best action replaces pruned ones, whose merit is unknown.
    """
    each = np.arange(len(merits))[:, None]
    order = np.argsort(-merits, axis=-1, kind="stable")[:, :N_CENTRES]
    order = np.where(np.isneginf(merits[each, order]), order[:, :1], order)
    return np.asarray(actions[each, order], np.float32), merits[each, order]


def numbers_of_shape(name: str, value: Any, shape: tuple[int | None, ...]) -> Float:
    """Return finite numbers of a shape, in which None stands for any number.

    Raises:
        ValueError: The value has another type or shape, or is not finite.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.full((), np.nan)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        wanted = f"{shape}".replace("None", "n")
        raise ValueError(f"{name} must be finite numbers of shape {wanted}, got {value!r:.60}")
    return array
