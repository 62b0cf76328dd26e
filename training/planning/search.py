"""Search for a movement with computed geometry, without a network and without simulation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.envs.common.arrays import Bool, Float, Single
from viapoint.envs.common.validation import whole_number
from viapoint.envs.env import ReachEnv
from viapoint.envs.geometry.compiled import compiled
from viapoint.envs.geometry.obstacles import Obstacles
from viapoint.envs.plans import Plan
from viapoint.envs.registration import check_registered
from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.envs.scenes.options import draw_given
from viapoint.envs.scenes.scene import Scenes
from viapoint.envs.task import Task
from viapoint.training.planning.candidates import (
    MOST_CANDIDATES,
    MOST_ROUNDS,
    candidate_actions,
    sobol_actions,
)
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.movements import (
    Setting,
    fine_table,
    least_clearance,
    memory_of,
    movement_table,
)
from viapoint.training.planning.plan_motion import checked_motion
from viapoint.training.planning.problem import (
    Moves,
    Numbers,
    Problem,
    movement_of,
    moves_of,
    setting_of,
    worth_of,
)
from viapoint.training.planning.refine import SMOOTH, refine_seeds, unit_of_jerk

# Least planned clearance of a movement that the search prefers, [m]; 1 to 8 mm make no difference
CLEARANCE_MARGIN = 0.001
# Reward by which another plan must be better than the present one, as each change of plan costs jerk
KEEP_BONUS = 0.1
# Times for which a plan is checked, shorter ones where none is clear for longer, [s]: obstacles may change course
HORIZONS = (1e9, 1.2, 0.9, 0.6, 0.3)
VERIFIED = 8  # Number of best candidates that are checked once more before one is taken
N_CENTRES = 4  # Number of best candidates that a round of refinement samples around
# Half the side of the cube that the first round samples around each centre; each further round halves it
SPREAD = 0.25
INFEASIBLE = -1e6  # Merit of plans that are not clear, less their depth


class GeometrySearch:
    """Planner that checks a fixed set of actions with computed geometry and takes the best one.

    The candidates are the zero action and the points of a Sobol sequence, the same in every scene. They are checked
    in the order of the reward that they would have without obstacles, until no other one can be better.

    When replanning, the present plan is kept as long as it is clear and no other plan is better by KEEP_BONUS. Where no
    plan is clear to its end, the search takes one that is clear for the longest of HORIZONS.

    Args:
        task: Task of an environment, or id of a registered environment.
        n_checks: Candidates checked before any refinement, 1 or more.
        refinements: Rounds in which `per_round` more candidates are checked around the best ones.
        per_round: Candidates of each round.
        **kwargs: Arguments of the environment, if an id is given.

    Example:
        >>> from viapoint.envs import Cylinder
        >>> from viapoint.training import GeometrySearch
        >>> search = GeometrySearch("viapoint/PlanarObstacles-v0", n_checks=64)
        >>> plan = search.plan((-0.2, 0.3), (0.1, 0.4), [Cylinder(0.03, 0.04, position=(-0.05, 0.35, 0.0))])
        >>> plan.success, plan.waypoints.shape, plan.durations.shape
        (True, (3, 2), (2,))
        >>> search.name, GeometrySearch("viapoint/PlanarObstacles-v0", 256, refinements=4).name
        ('sobol64', 'search512')
    """

    def __init__(
        self,
        task: Task | str,
        n_checks: int = 512,
        *,
        refinements: int = 0,
        per_round: int = 64,
        **kwargs: Any,
    ) -> None:
        self.task = registered_task(task, **kwargs) if isinstance(task, str) else task
        self.n_checks = whole_number("n_checks", n_checks, 1, MOST_CANDIDATES)
        self.refinements = whole_number("refinements", refinements, 0, MOST_ROUNDS)
        self.per_round = whole_number("per_round", per_round, 1, MOST_CANDIDATES)
        whole_number("number of all checks", self.total_checks, 1, MOST_CANDIDATES)

    @property
    def total_checks(self) -> int:
        """Number of candidates that are checked for one decision."""
        return self.n_checks + self.refinements * self.per_round

    @property
    def name(self) -> str:
        """Name in tables of results and on the command line, such as search512, or sobol512 without refinement."""
        return f"{'search' if self.refinements else 'sobol'}{self.total_checks}"

    def decide(self, observation: Mapping[str, Any], scenes: Any = None) -> Float:
        """Return the best action of each of B observations, shape (B, m); the scenes are not used."""
        return self.solve(Problem.of_observation(observation, self.task))

    def solve(self, problem: Problem, n_pieces: int = 1) -> Float:
        """Return the best action of each of B problems, shape (B, m).

        While a movement is under way, courses of obstacles may have several pieces of CHORD: then the obstacles are
        those of as many scenes for each problem, one after the other in time.
        """
        moving = problem.remaining is not None
        at = self.task.n_via * self.task.action.dimension
        fixed = None if moving or not at else at  # from rest the duration stays as it is
        actions = candidate_actions(self.task, self.n_checks, replanning=moving)
        candidates = np.broadcast_to(actions, (len(problem.start), *actions.shape))
        setting = setting_of(self.task, problem.obstacles)._replace(n_pieces=n_pieces)
        merit = merits(self.task, problem, candidates, setting)
        for each in range(self.refinements):
            top = np.argsort(-merit, axis=-1, kind="stable")[:, :N_CENTRES]
            centres = np.take_along_axis(candidates, top[..., None], axis=1)
            steps = SPREAD * 0.5**each * sobol_actions(self.per_round + 1, self.task.action.size, fixed)[1:]
            near = np.clip(centres[:, np.arange(self.per_round) % centres.shape[1]] + steps, -1.0, 1.0)
            candidates = np.concatenate((candidates, near), axis=1)
            merit = np.concatenate((merit, merits(self.task, problem, near, setting)), axis=1)
        return best_of(self.task, problem, candidates, merit).astype(np.float64)

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
        if np.ndim(observation["joints"]) > 1:
            return self.decide(observation).astype(np.float32), None
        alone = {name: np.asarray(part)[None] for name, part in observation.items()}
        return self.decide(alone)[0].astype(np.float32), None

    def plan(self, start: Any, goal: Any, obstacles: Any = ()) -> MotionPlan:
        """Return the best plan from rest at `start` to rest at `goal` among obstacles that stand still.

        The arguments are as the options of `reset`. Where no candidate stays clear and in reach, the plan is the one
        with the least violation, and has no success. ValueError: an end is out of reach or touches an obstacle.
        """
        given = {"start": start, "goal": goal, "obstacles": obstacles}
        return self.plan_scene(draw_given(given, self.task.sampler(), [np.random.default_rng(0)]))

    def plan_scene(self, scene: Scenes, *, shortest: bool = False) -> MotionPlan:
        """Return the best plan of one scene, with `shortest` in the shortest duration that the limits allow."""
        task, problem = self.task, Problem.of_scenes(scene, self.task)
        plan = task.action.decode(self.solve(problem), problem.start, problem.goal).take(0)
        return checked_motion(
            task.arm, task.space_name, plan, problem.obstacles, self.name, shortest=shortest
        )


def best_of(task: Task, problem: Problem, actions: Numbers, merit: Numbers) -> Numbers:
    """Return the best of actions of shape (B, H, m), shape (B, m), by their merits, shape (B, H).

    Merits are of movements that differ a little from the executed ones. So a movement from rest is checked once more,
    as it will be executed; if it is not clear, the best of the others is taken, several times if need be.
    """
    best = merit.argmax(axis=1)
    if problem.remaining is None:
        barred = np.zeros(merit.shape, bool)
        least = 0.5 * CLEARANCE_MARGIN
        rows = np.flatnonzero(merit.max(axis=1) > 0.5 * INFEASIBLE)
        for _ in range(VERIFIED if rows.size else 0):
            some = problem.take(rows)
            chosen = actions[rows, best[rows]][:, None]
            rows = rows[plan_clearances(task, some, chosen, least, least, exact=True)[:, 0] < least]
            if not rows.size:
                break
            barred[rows, best[rows]] = True
            again = merits(task, problem.take(rows), actions[rows], barred=barred[rows])
            best[rows] = again.argmax(axis=1)
    return np.asarray(actions[np.arange(len(best)), best])


def merits(
    task: Task,
    problem: Problem,
    actions: Numbers,
    setting: Setting | None = None,
    *,
    barred: Bool | None = None,
) -> Float:
    """Return the merit of actions of shape (B, H, m), by which the best one has the greatest, shape (B, H).

    The merit of a clear plan is its reward if the physics follows it, and that of others is near INFEASIBLE. It is a
    lower bound for plans that are certainly no better than another one. When replanning, a first action of zero, which
    keeps the plan, gains KEEP_BONUS. Actions that are barred, by a mask of shape (B, H), are not considered.
    """
    moves = moves_of(task, problem, actions)
    worth = worth_of(task, problem, moves)
    if barred is not None:
        worth[barred] = 3.0 * INFEASIBLE
    replanning = problem.remaining is not None
    if replanning and not actions[:, 0].any():
        worth[:, 0] += KEEP_BONUS
    setting = setting or setting_of(task, problem.obstacles)
    horizons = np.array(HORIZONS if replanning else HORIZONS[:1])
    gain = task.weights.clearance / CLEARANCE_UNIT
    return _merits(setting, moves, worth, problem.obstacles, horizons, gain)


def refined_actions(task: Task, problem: Problem, actions: Numbers) -> Numbers:
    """Return actions of shape (B, H, m) after a refinement of their via-points by the gradient of clearance and jerk.

    Movements begin at rest. Durations relative to the shortest movement stay as they are. In joint space via-points
    stay within the action space; in hand space what lies outside is clipped.
    """
    table, fine = movement_table(task.n_via), fine_table(task.n_via)
    setting = setting_of(task, problem.obstacles, exact=True)
    moves = moves_of(task, problem, actions)
    found = np.array(actions)
    number, at = task.n_via, task.n_via * task.action.dimension
    room = np.inf if setting.of_hand else task.action.via_scale
    for b in range(len(found)):
        start = problem.start[b]
        line = problem.goal[b] - problem.start[b]
        seeds = moves.offsets[b, :, :number].copy()
        fixed = moves.offsets[b, 0, number:].copy()
        middle = line * np.arange(1, number + 1)[:, None] / (number + 1)
        bounds = np.stack((middle - room, middle + room))
        _, better = refine_seeds(
            setting, table, fine, start, fixed, seeds, bounds, moves.duration[b, 0], problem.obstacles.take([b]),
            CLEARANCE_MARGIN, unit_of_jerk(line, setting.of_hand), SMOOTH, np.inf, len(seeds), np.inf,
        )  # fmt: skip
        waypoints = np.zeros((len(seeds), number + 2, len(start)))
        waypoints[:, 1:-1] = better.vias
        waypoints[:, -1] = line
        refined = task.action.encode(Plan(start + waypoints, table.durations[better.times]))
        refined[:, at] = actions[b, :, at]
        found[b] = np.clip(refined, -1.0, 1.0)
    return found


def plan_clearances(
    task: Task,
    problem: Problem,
    actions: Numbers,
    most: float,
    least: float,
    *,
    exact: bool = False,
    until: float = HORIZONS[0],
) -> Float:
    """Return the planned clearances of actions of shape (B, H, m), shape (B, H), [m].

    They are at most `most`, and below `least` the exact value does not matter, [m]. After the time `until`, [s],
    nothing counts. With `exact`, movements are those that are executed, looked at in many instants.
    """
    moves = moves_of(task, problem, actions, exact=exact)
    setting = setting_of(task, problem.obstacles, exact=exact)
    return np.asarray(_clearances(setting, moves, problem.obstacles, most, least, until))


@compiled
def _clearances(
    setting: Setting, moves: Moves, obstacles: Obstacles, most: float, least: float, until: float
) -> Float:
    """Return the clearances of H plans in each of B problems, see :func:`plan_clearances`."""
    number, plans = moves.duration.shape
    found = np.empty((number, plans))
    memory = memory_of(setting, moves.table, moves.start.shape[1])
    for b in range(number):
        for h in range(plans):
            movement = movement_of(moves, b, h)
            found[b, h] = least_clearance(setting, movement, obstacles, b, most, least, until, memory)
    return found


@compiled
def _merits(
    setting: Setting, moves: Moves, worth: Float, obstacles: Obstacles, horizons: Float, gain: float
) -> Float:
    """Return the merits of H plans in each of B problems, see :func:`merits`."""
    number, plans = worth.shape
    found = np.full((number, plans), 3.0 * INFEASIBLE)
    memory = memory_of(setting, moves.table, moves.start.shape[1])
    high = CLEARANCE_RANGE[1]
    for b in range(number):
        order = np.argsort(-worth[b])
        for rank in range(len(horizons)):
            best, deepest = 2.0 * INFEASIBLE, -1e9
            for h in order:
                if worth[b, h] + gain * high - rank <= best:
                    break
                floor = CLEARANCE_MARGIN if best > INFEASIBLE else min(deepest, CLEARANCE_MARGIN)
                clearance = least_clearance(
                    setting, movement_of(moves, b, h), obstacles, b, high, floor, horizons[rank], memory
                )
                if clearance >= CLEARANCE_MARGIN:
                    value = worth[b, h] + gain * clearance - rank
                    best = max(best, value)
                else:
                    value = INFEASIBLE + clearance
                    deepest = max(deepest, clearance)
                found[b, h] = max(found[b, h], value)
            if best > INFEASIBLE:
                break
    return found


def registered_task(env_id: str, **kwargs: Any) -> Task:
    """Return the task of a registered environment made with `kwargs`; ValueError if it is not of this package."""
    check_registered(env_id)
    env: Any = gym.make_vec(env_id, num_envs=1, **kwargs)
    task = getattr(env.unwrapped, "task", None)
    single = [each.unwrapped for each in getattr(env.unwrapped, "envs", ())]
    env.close()
    if any(isinstance(each, ReachEnv) for each in single):
        raise ValueError(
            f"{env_id} must be registered with vector_entry_point='viapoint.envs.vector_env:ReachVectorEnv', too"
        )
    if not isinstance(task, Task):
        raise ValueError(f"{env_id} is not an environment of this package")
    return task
