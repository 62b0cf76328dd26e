"""Decisions on the live page: ranked proposals of an agent, or of the geometry search where there is none."""

from __future__ import annotations

import dataclasses
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from viapoint import primitives
from viapoint.envs.actions.via_points import Plan
from viapoint.envs.common.types import Float, Int, Observation, Single
from viapoint.envs.mdp.observation import is_replanning
from viapoint.training.planning.baselines import agent_method
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.planning.plan_checks import CLEARANCE_MARGIN, REACH_MARGIN, check_plans, merit
from viapoint.training.planning.planned_movements import plan_movements

if TYPE_CHECKING:
    from viapoint.envs.mdp.task import Task
    from viapoint.training.live.scene_file import LiveScene

N_PROPOSALS = 5
"""Proposals that are shown."""
N_CANDIDATES = 256
"""Best candidates among which distinct proposals are looked for."""
APART = 0.03
"""Distance by which the paths of two proposals differ somewhere, [m]."""
N_CHECKS = 512
"""Candidates of the geometry search."""
POINTS = 48
"""Points of a drawn path."""


class Proposal(NamedTuple):
    """One plan that was considered, with what is expected of it."""

    rank: int
    """Rank among all candidates, from 1; 0 for a plan made by hand."""
    plan: Plan
    """Waypoints (K + 2, D), [m], and durations (K + 1,), [s]."""
    reward: float
    """Expected reward: that of the agent's critic, or else the computed one."""
    clearance: float
    """Computed clearance of the plan, [m]."""
    predicted: float | None
    """Clearance that the agent predicts, [m]; None where it predicts none."""
    reachable: bool
    """True if the whole plan is within the arm's reach."""
    jerk_ratio: float
    """Jerk cost relative to that of the straight movement of the same duration."""

    @property
    def clear(self) -> bool:
        """True if the plan is within reach and touches nothing."""
        return self.reachable and self.clearance > 0.0

    @property
    def duration(self) -> float:
        """Duration of the plan, [s]."""
        return float(np.sum(self.plan.durations))

    def path(self) -> Float:
        """Return the path of the hand at POINTS instants, shape (POINTS, D), [m]."""
        return np.asarray(self.plan.trajectory().sample(POINTS, 0)[0])


class Decision(NamedTuple):
    """Result of one decision."""

    chosen: Proposal
    """Plan that was chosen."""
    action: Single
    """Its action, shape (m,)."""
    maker: str
    """Name of the method that decided."""
    seconds: float
    """Time that the decision took, [s]."""
    task: Task
    """Task whose actions were considered."""
    considered: tuple[Single, Float] | None
    """Considered actions, shape (N, m), and their ranking criterion, shape (N,); None if not kept."""


class DecisionMaker:
    """Maker of decisions that several threads share.

    Args:
        task: Task whose actions are whole movements or revisions of them.
        agent: Agent of that task; None for the geometry search alone.
    """

    def __init__(self, task: Task, agent: Any = None) -> None:
        self.task, self._agent, self._lock = task, agent, threading.Lock()
        self.ranks = agent is not None and hasattr(agent.policy, "propose")
        """True if the agent ranks many candidates, False if it proposes one action."""
        self._searches: dict[int, GeometrySearch] = {}

    def choose(self, observation: Observation, *, n_via: int | None = None, checks: int = 0) -> Decision:
        """Decide in one scene.

        Args:
            observation: Parts of one observation, shape (1, .) each.
            n_via: Number of via-points; with another number than the agent's, the geometry search decides.
            checks: Proposals that the agent checks with computed geometry, if it ranks candidates.
        """
        own = self.task.action.n_via
        task = self.task if n_via in (None, own) else self._task_with(int(n_via or 0))
        considered, begin = None, time.perf_counter()
        if self._agent is None or task is not self.task:
            search = self._search_of(task)
            action, maker = search.decide(observation)[0], search.name
        elif self.ranks and not checks:
            with self._lock:
                considered = self._considered(observation)
            action, maker = considered[0][considered[1].argmax()], "agent"
        else:
            action = self.action(observation, checks)[0]
            maker = f"agent, {checks} checks" if checks else "agent"
        seconds = time.perf_counter() - begin
        action = np.asarray(action, dtype=np.float32)
        (chosen,) = _computed_proposals(observation, task, action[None])
        return Decision(chosen, action, maker, seconds, task, considered)

    def action(self, observation: Observation, checks: int = 0) -> Float:
        """Return the chosen action alone, shape (1, m)."""
        if self._agent is None:
            return self._search_of(self.task).decide(observation)
        scenes: Any = None
        method = agent_method("agent", self._agent, checks if self.ranks else None)
        with self._lock:
            return method.decide(observation, scenes)

    def proposals(self, observation: Observation, decision: Decision) -> tuple[Proposal, ...]:
        """Return the chosen plan and the best others that differ from it, with their ranks."""
        task = decision.task
        if decision.maker.startswith("search"):
            actions = candidate_actions(task, N_CHECKS, replanning=is_replanning(observation))
            checks = check_plans(observation, actions[None], task)
            values = merit(checks, CLEARANCE_MARGIN, REACH_MARGIN)[0]
        elif not self.ranks:
            return (decision.chosen,)
        elif decision.considered is not None:
            actions, values = decision.considered
        else:
            with self._lock:
                actions, values = self._considered(observation)
        actions, ranks = _distinct(observation, task, decision.action, actions, values)
        found = self._proposals(observation, task, actions, decision.maker)
        return tuple(each._replace(rank=int(rank)) for each, rank in zip(found, ranks, strict=True))

    def evaluate(self, observation: Observation, plan: Plan) -> Proposal:
        """Return a plan made by hand as a proposal of rank 0."""
        number = len(plan.durations) - 1
        task = self.task if number == self.task.action.n_via else self._task_with(number)
        action = np.asarray(task.action.encode(plan), dtype=np.float32)
        return _computed_proposals(observation, task, action[None])[0]._replace(plan=plan, rank=0)

    def _considered(self, observation: Observation) -> tuple[Single, Float]:
        """Return the agent's candidates and its ranking criterion."""
        actions, values = (part[0] for part in self._agent.policy.propose(observation))
        return np.asarray(actions, dtype=np.float32), np.asarray(values, dtype=np.float64)

    def _proposals(self, observation: Observation, task: Task, actions: Single, maker: str) -> list[Proposal]:
        """Return proposals of some actions, shape (P, m), with the rewards that their maker expects."""
        found = _computed_proposals(observation, task, actions)
        if not self.ranks or not maker.startswith("agent"):
            return found
        policy = self._agent.policy
        with self._lock, torch.no_grad():
            values = policy.critic(policy.inputs(observation, actions[None]))
            rewards, margins = policy.critic.value(values)[0].tolist(), values.margin[0].tolist()
        return [
            each._replace(reward=reward, predicted=margin)
            for each, reward, margin in zip(found, rewards, margins, strict=True)
        ]

    def _search_of(self, task: Task) -> GeometrySearch:
        return self._searches.setdefault(task.action.n_via, GeometrySearch(task, N_CHECKS))

    def _task_with(self, n_via: int) -> Task:
        action = dataclasses.replace(self.task.action, n_via=n_via)
        return dataclasses.replace(self.task, action=action)


def plan_by_hand(scene: LiveScene, vias: Float, duration: float) -> Plan:
    """Return the plan from start to goal through via-points, shape (K, D), [m], in a duration, [s]."""
    waypoints = np.concatenate((scene.start[None], vias, scene.goal[None]))
    return Plan(waypoints, np.asarray(primitives.passage_durations(waypoints, np.asarray(duration))))


def _distinct(
    observation: Observation, task: Task, chosen: Single, actions: Single, values: Float
) -> tuple[Single, Int]:
    """Return the chosen action and the best ones whose paths differ, shape (P, m), and their ranks, shape (P,)."""
    order = np.argsort(-values, kind="stable")
    number = np.flatnonzero((actions[order] == chosen).all(axis=-1))
    first = int(number[0]) if number.size else 0
    best = order[:N_CANDIDATES]
    candidates = np.concatenate((chosen[None], actions[best]))
    fractions = np.linspace(0.0, 1.0, 9)[1:-1]
    paths = plan_movements(observation, candidates[None], task, fractions).path[0]
    kept = [0]
    left = np.full(len(paths), np.inf)
    while len(kept) < N_PROPOSALS:
        left = np.minimum(left, np.sqrt(((paths - paths[kept[-1]]) ** 2).sum(axis=-1)).max(axis=-1))
        others = np.flatnonzero(left > APART)
        if not others.size:
            break
        kept.append(int(others[0]))
    ranks = np.array([first + 1, *kept[1:]])  # candidate i has rank i: the chosen one is row 0
    return np.asarray(candidates[kept], np.float32), ranks


def _computed_proposals(observation: Observation, task: Task, actions: Single) -> list[Proposal]:
    """Return proposals of some actions, shape (P, m), with computed rewards."""
    number = len(actions)
    checks = check_plans(observation, actions[None], task)
    moves = plan_movements(observation, actions[None], task, np.linspace(0.0, 1.0, 3))
    start, goal = (
        np.repeat(observation[name].astype(np.float64), number, axis=0) for name in ("hand", "goal")
    )
    plans = task.action.decode(np.asarray(actions, dtype=np.float64), start, goal)
    return [
        Proposal(
            rank=1, plan=plans.take(i), reward=float(checks.reward[0, i]),
            clearance=float(checks.clearance[0, i]), predicted=None,
            reachable=bool(checks.reach_margin[0, i] >= 0.0), jerk_ratio=float(np.exp(moves.log_jerk[0, i])),
        )
        for i in range(number)
    ]  # fmt: skip


def describe_plan(plan: Proposal) -> str:
    """Return one sentence on a plan."""
    if not plan.reachable:
        return "This plan leaves the arm's reach."
    if plan.clearance <= 0.0:
        return f"This plan touches an obstacle: {-1e3 * plan.clearance:.0f} mm deep."
    clear = "no obstacle near" if plan.clearance >= 0.999 else f"{1e3 * plan.clearance:.0f} mm clear"
    jerk = f"{plan.jerk_ratio:.1f} times the jerk of the straight line"
    return f"The plan takes {plan.duration:.2f} s, {clear}, with {jerk}."
