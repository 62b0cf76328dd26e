"""Decisions on the live page: plans of the motion planner, and ranked proposals of an agent or the geometry search."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import Any, NamedTuple

import numpy as np

from viapoint import primitives
from viapoint.envs import Plan, Scenes, Task
from viapoint.envs.common.arrays import norm
from viapoint.envs.common.types import Float, Observation
from viapoint.envs.geometry.clearance import FAR
from viapoint.envs.outcome import straight_jerk_cost
from viapoint.envs.plans import Movements, jerk_cost_between
from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT
from viapoint.training.live.movements import Profile, plan_profile
from viapoint.training.live.scene import LiveScene
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.motion_plan import MotionPlan
from viapoint.training.planning.plan_motion import SEEDS, plan_motion
from viapoint.training.planning.problem import Problem, moves_of, worth_of
from viapoint.training.planning.search import GeometrySearch, merits

N_PROPOSALS = 5
"""Proposals that are shown."""
N_CANDIDATES = 256
"""Best candidates among which distinct proposals are looked for."""
APART = 0.03
"""Distance by which the paths of two proposals differ somewhere, [m]."""
N_CHECKS, REFINEMENTS = 512, 3
"""Candidates of the geometry search, and rounds of refinement around the best of them."""


class Proposal(NamedTuple):
    """One plan that was considered, with what is expected of it."""

    rank: int
    """Rank among all candidates, from 1; 0 for a plan made by hand."""
    plan: Plan
    """Waypoints (K + 2, D) and durations (K + 1,), [s]."""
    reward: float | None
    """Computed reward; None for a plan that fails."""
    predicted: float | None
    """Value by which the agent ranks the plan; None where the search decides."""
    profile: Profile
    """The plan over time."""
    reachable: bool
    """True if the whole plan is within the arm's reach."""
    jerk_ratio: float
    """Jerk cost relative to that of the straight movement of the same duration."""
    reason: str = ""
    """Reason why the motion planner found no better plan; empty for a free plan and for other methods."""

    @property
    def clearance(self) -> float:
        """Computed clearance of the plan from obstacles, [m]."""
        return float(self.profile.clearance.min())

    @property
    def self_clearance(self) -> float:
        """Computed clearance of the arm from itself, [m]."""
        return float(self.profile.own.min())

    @property
    def clear(self) -> bool:
        """True if the plan is within reach and touches nothing."""
        return not self.reason and self.reachable and min(self.clearance, self.self_clearance) > 0.0

    @property
    def duration(self) -> float:
        """Duration of the plan, [s]."""
        return float(self.plan.duration)


MOTION = "motion planner"
"""Name of the method :func:`plan_motion`, the default of tasks in which plans are not revised."""
AGENT, SEARCH = "agent", "geometry search"
"""Names of the other methods."""
TIME_LIMIT, SECOND_LIMIT = 0.03, 0.3
"""Time limits of the motion planner during a drag, and in a pause where that found no free movement, [s]."""


class Decision(NamedTuple):
    """Result of one decision."""

    chosen: Proposal
    """Plan that was chosen."""
    action: Float
    """Its action, shape (m,)."""
    maker: str
    """Name of the method that decided."""
    seconds: float
    """Time that the decision took, [s]."""
    task: Task
    """Task whose actions were considered."""
    motion: MotionPlan | None = None
    """Plan of the motion planner; None for other methods."""


class DecisionMaker:
    """Maker of decisions that several threads share.

    Args:
        task: Task whose actions are whole movements or revisions of them.
        agent: Agent of that task; None for the geometry search alone.
    """

    def __init__(self, task: Task, agent: Any = None) -> None:
        self.task, self._agent, self._lock = task, agent, threading.Lock()
        policy = getattr(agent, "policy", None)
        self.ranks = hasattr(policy, "propose")
        """True if the agent ranks many candidates, False if it proposes one action."""
        self.checks = hasattr(policy, "checks")
        """True if the agent can check its proposals with computed geometry."""

    def plan(
        self,
        scene: LiveScene,
        n_via: int,
        duration: float | None,
        last: MotionPlan | None,
        time_limit: float = TIME_LIMIT,
    ) -> Decision:
        """Plan with the motion planner, which also says why there is no free movement.

        Args:
            scene: Scene, possible or not.
            n_via: Number of via-points, 1 to 3.
            duration: Duration, [s]; None for the shortest.
            last: Last plan, whose via-points are tried first.
            time_limit: Time after which no further seed is tried, [s].
        """
        vias = None if last is None else last.waypoints[1:-1]
        again = vias is not None and len(vias) == n_via and time_limit == TIME_LIMIT
        seeds = vias[None] if vias is not None and again else SEEDS
        begin = time.perf_counter()
        motion = plan_motion(
            self.task.arm,
            scene.start,
            scene.goal,
            scene.packed,
            n_via=n_via,
            seeds=seeds,
            time_limit=time_limit,
            duration=duration,
            space=self.task.space_name,
            ompl=False,
        )
        seconds = time.perf_counter() - begin
        profile = plan_profile(self.task, scene.packed, motion.plan)
        inside = bool(self.task.space.inside(profile.coordinates).all())
        chosen = Proposal(1, motion.plan, None, None, profile, inside, motion.jerk, motion.reason)
        return Decision(chosen, np.zeros(0), MOTION, seconds, self.task, motion)

    def choose(
        self,
        observation: Observation,
        scenes: Scenes,
        *,
        n_via: int | None = None,
        checks: int = 0,
        by_agent: bool = True,
    ) -> Decision:
        """Decide in one scene with the agent or the geometry search.

        Args:
            observation: Parts of the first observation, shape (1, .) each.
            scenes: Batch of this one scene.
            n_via: Number of via-points; with another number than the agent's, the geometry search decides.
            checks: Proposals that the agent checks with computed geometry.
            by_agent: True for the agent, if there is one.
        """
        own = n_via in (None, self.task.n_via)
        task = self.task if own else dataclasses.replace(self.task, n_via=int(n_via or 0))
        begin = time.perf_counter()
        if own and by_agent and self._agent is not None:
            action = self.action(observation, checks)[0]
            maker = f"agent, {checks} checks" if checks else "agent"
        else:
            search = _search(task)
            action, maker = search.solve(Problem.of_scenes(scenes, task))[0], search.name
        seconds = time.perf_counter() - begin
        (chosen,) = evaluated(task, scenes, np.asarray(action, dtype=np.float64)[None])
        return Decision(chosen, action, maker, seconds, task)

    def action(self, observation: Observation, checks: int = 0) -> Float:
        """Return the chosen action alone, shape (1, m)."""
        if self._agent is None:
            return self.search(observation)
        with self._lock:
            if self.checks:
                self._agent.policy.checks = checks
            actions, _ = self._agent.predict(observation, deterministic=True)
        return np.asarray(actions, dtype=np.float64)

    def search(self, observation: Observation) -> Float:
        """Return the action that the geometry search chooses, shape (1, m)."""
        return _search(self.task).decide(observation)

    def proposals(self, observation: Observation, scenes: Scenes, decision: Decision) -> tuple[Proposal, ...]:
        """Return the chosen plan and the best others that differ from it, with their ranks."""
        task, by_agent = decision.task, decision.maker.startswith("agent")
        if decision.motion is not None or (by_agent and not self.ranks):
            return (decision.chosen,)
        if by_agent:
            with self._lock:
                problem = Problem.of_observation(observation, task)
                actions, values = (part[0] for part in self._agent.policy.propose(problem))
        else:
            actions = candidate_actions(task, N_CHECKS, replanning=False)
            values = _each_merit(task, scenes, np.asarray(actions, dtype=np.float64))
        actions = np.asarray(actions, dtype=np.float64)
        order = np.argsort(-values, kind="stable")[:N_CANDIDATES]
        chosen = np.asarray(decision.action, dtype=np.float64)
        known = np.flatnonzero((actions[order] == chosen).all(axis=-1))
        every = np.concatenate((chosen[None], actions[order]))
        kept = _distinct(task, scenes, every)
        first, *others = evaluated(task, scenes, every[kept])
        # A chosen action that is no candidate comes from refinement, and stands before all candidates.
        best = int(known[0]) + 1 if known.size else 1
        expected = [float(value) if by_agent else None for value in values[order]]
        found = [first._replace(rank=best, predicted=expected[known[0]] if known.size else None)]
        for each, place in zip(others, kept[1:], strict=True):
            rank = place if known.size else place + 1
            found.append(each._replace(rank=rank, predicted=expected[place - 1]))
        return tuple(found)

    def evaluate(self, scenes: Scenes, plan: Plan) -> Proposal:
        """Return a plan made by hand as a proposal of rank 0."""
        task = dataclasses.replace(self.task, n_via=len(plan.durations) - 1)
        action = task.action.encode(plan)
        return evaluated(task, scenes, action[None])[0]._replace(rank=0)


def plan_by_hand(scene: LiveScene, vias: Float, duration: float) -> Plan:
    """Return the plan from start to goal through via-points, shape (K, D), in a duration, [s]."""
    waypoints = np.concatenate((scene.start[None], vias, scene.goal[None]))
    return Plan(waypoints, np.asarray(primitives.passage_durations(waypoints, np.asarray(duration))))


def evaluated(task: Task, scenes: Scenes, actions: Float) -> list[Proposal]:
    """Return proposals of some actions in a batch of one scene, shape (P, m), with computed rewards."""
    problem = Problem.of_scenes(scenes, task)
    plans = _plans(task, problem, actions)
    worth = worth_of(task, problem, moves_of(task, problem, actions[None]))[0]
    cost = jerk_cost_between(Movements.of(plans), np.zeros(len(actions)), plans.duration)
    straight = straight_jerk_cost(norm(problem.goal - problem.start), plans.duration)
    found = []
    for i in range(len(actions)):
        plan = Plan(plans.waypoints[i], plans.durations[i])
        profile = plan_profile(task, scenes.obstacles, plan)
        inside = bool(task.space.inside(profile.coordinates).all())
        proposal = Proposal(1, plan, None, None, profile, inside, float(cost[i] / straight[i]))
        if proposal.clear:
            clearance = min(proposal.clearance, proposal.self_clearance, CLEARANCE_RANGE[1])
            reward = float(worth[i]) + task.weights.clearance * clearance / CLEARANCE_UNIT
            proposal = proposal._replace(reward=reward)
        found.append(proposal)
    return found


def describe_plan(plan: Proposal) -> str:
    """Return one sentence on a plan."""
    if plan.reason:
        return f"No free movement was found: {plan.reason}. The best one is shown in red."
    if not plan.reachable:
        return "This plan leaves the arm's reach."
    if plan.clearance <= 0.0:
        return f"This plan touches an obstacle: {-1e3 * plan.clearance:.1f} mm deep."
    if plan.self_clearance <= 0.0:
        return f"In this plan the arm touches itself: {-1e3 * plan.self_clearance:.1f} mm deep."
    clear = "no obstacle near" if plan.clearance >= 0.999 * FAR else f"{1e3 * plan.clearance:.0f} mm clear"
    jerk = f"{plan.jerk_ratio:.1f} times the jerk of the straight line"
    return f"The plan takes {plan.duration:.2f} s, {clear}, with {jerk}."


def _search(task: Task) -> GeometrySearch:
    """Return the geometry search of a task."""
    return GeometrySearch(task, N_CHECKS, refinements=REFINEMENTS)


def _each_merit(task: Task, scenes: Scenes, actions: Float) -> Float:
    """Return the merits of actions of shape (P, m) in a batch of one scene, shape (P,).

    Each is a problem of its own, as the merits of several actions in one problem are bounds for all but the best.
    """
    problem = Problem.of_scenes(scenes, task).take(np.zeros(len(actions), np.int64))
    return np.asarray(merits(task, problem, actions[:, None])[:, 0])


def _plans(task: Task, problem: Problem, actions: Float) -> Plan:
    """Return the plans of actions of shape (P, m) in one problem."""
    start, goal = (np.repeat(end, len(actions), axis=0) for end in (problem.start, problem.goal))
    return task.action.decode(actions, start, goal)


def _distinct(task: Task, scenes: Scenes, actions: Float) -> list[int]:
    """Return the first action and the next ones whose paths of the tool differ, as indices."""
    plans = _plans(task, Problem.of_scenes(scenes, task), actions)
    instants = plans.duration[:, None] * np.linspace(0.0, 1.0, 9)[1:-1]
    paths = task.arm.hand(task.space.joints(np.asarray(plans.trajectory()(instants))))
    kept = [0]
    least = np.full(len(actions), np.inf)
    while len(kept) < N_PROPOSALS:
        least = np.minimum(least, norm(paths - paths[kept[-1]]).max(axis=-1))
        others = np.flatnonzero(least > APART)
        if not others.size:
            break
        kept.append(int(others[0]))
    return kept
