"""Policy of viaq: candidate plans, a critic that ranks them, and exact checks or refinement of the best ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor

from viapoint.envs.common.arrays import Float, norm
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import turned
from viapoint.envs.task import Task
from viapoint.training.agents.pairs import pairs_of
from viapoint.training.agents.plan_agent import Numbers, Observation, PlanPolicy
from viapoint.training.agents.viaq_critic import PlanInputs, ViaQCritic
from viapoint.training.planning.movements import INSTANTS
from viapoint.training.planning.problem import Problem, moves_of
from viapoint.training.planning.search import INFEASIBLE, best_of, merits, refined_actions

KEEP = 0.1  # Minimum gain of Q for which a running plan is revised
# Greatest number of proposals that are checked; all further checks are of plans around the best of them
PROPOSALS = 32
# Least distance of the via-points of two candidates that are refined, in the action space. Of .2 to 1.8, .5 solved most
# of the `validation` scenes of PandaObstacles.
APART = 0.5
LOCAL_ROUNDS = 4  # Rounds of checks around the best checked plans
SPARE = 0.2  # Greatest time that is left after a movement, or missing for it, at the input of the critic, [s]
BLOCK = 64  # Scenes that are decided together
MOTION_SCALES = (1.0, 0.1)  # Scales of velocity and acceleration at the input of the critic


class ViaQPolicy(PlanPolicy):
    """Policy that ranks candidates with a critic and can check the best ones with exact geometry.

    Args:
        observation_space: Observation space of the environment.
        action_space: Action space of the environment.
        lr_schedule: Learning rate as a function of the remaining progress.
        task: Task of the environment as plain values, see :meth:`viapoint.envs.task.Task.as_dict`.
        width: Width of the hidden layers of the pair network.
        instants: Instants of a plan at which the arm is looked at, 2 to 64.
        candidates: Number of Sobol points in the action space.
        refinements: Rounds of candidates around the best ones.
        per_refinement: Candidates of each round.
        checks: Greatest number of plans that exact geometry checks, the best candidates first; 0 for none.
        refine: Number of best candidates, some distance apart, that the planner refines by the gradient of clearance;
            the best one is taken after an exact check. 0 for none. Only for tasks whose actions are whole movements.
    """

    OWN = "width", "instants", "candidates", "refinements", "per_refinement", "checks", "refine"

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Any,
        *,
        task: Mapping[str, Any],
        width: int = 32,
        instants: int = 32,
        candidates: int = 256,
        refinements: int = 4,
        per_refinement: int = 64,
        checks: int = 0,
        refine: int = 0,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, task=task, **kwargs)
        self.width = width
        self.instants = instants
        self.candidates = candidates
        self.refinements = refinements
        self.per_refinement = per_refinement
        self.checks = checks
        self.refine = refine
        self._check_candidates()
        self._check_refine()
        self.critic = ViaQCritic(self.task, width=self.width)
        self.critic_target: ViaQCritic | None = None
        if self.replanning:  # values of later decisions are learned from a critic that changes slowly
            self.critic_target = ViaQCritic(self.task, width=self.width)
            self.critic_target.load_state_dict(self.critic.state_dict())
            self.critic_target.requires_grad_(False)
        self._make_optimizer(self.critic, lr_schedule)

    @property
    def network(self) -> ViaQCritic:
        """Network that is trained."""
        return self.critic

    def inputs(self, problem: Problem, actions: Numbers, until: Float | None = None) -> PlanInputs:
        """Return the critic's inputs for actions of shape (B, H, m) in B problems.

        After the times `until`, shape (B, H), [s], contact does not count.
        """
        moves = moves_of(self.task, problem, actions)
        spare = np.zeros_like(moves.duration)
        if problem.time_left is not None:
            spare = np.clip(problem.time_left[:, None] - moves.duration - SETTLING, -SPARE, SPARE)
        effort = np.stack((moves.rough, moves.relative, np.log(moves.relative), spare), axis=-1)
        instants = np.linspace(0, INSTANTS - 1, min(self.instants, INSTANTS)).round().astype(np.int64)
        pairs = pairs_of(self.task, problem, moves, instants, until)
        ends = seen_ends(self.task, problem)
        # Geometry is computed on the processor, the networks may be on another device.
        device = self.device
        return PlanInputs(
            _tensor(ends).to(device),
            _tensor(actions).to(device),
            _tensor(effort).to(device),
            pairs.to(device),
        )

    @torch.inference_mode()
    def values(self, problem: Problem, actions: Numbers) -> Numbers:
        """Return the ranking criterion of H actions in each of B problems, shape (B, H); see :meth:`ViaQCritic.merit`.

        In replanning tasks a first action of zero, which keeps the plan, gets a bonus of KEEP.
        """
        values: Numbers = self.critic.merit(self.critic(self.inputs(problem, actions))).cpu().numpy()
        if self.replanning:
            values[:, 0] += np.where((actions[:, 0] == 0.0).all(axis=-1), KEEP, 0.0)
        return values

    def propose(self, problem: Problem) -> tuple[Numbers, Numbers]:
        """Return candidates, shape (B, N, m), and their ranking criterion, shape (B, N); the first is zero."""
        return self.proposals(len(problem.start), lambda actions: self.values(problem, actions))

    def decide(self, observation: Observation) -> Numbers:
        """Return the chosen actions, shape (B, m), for B observations, arrays by name."""
        self._check_refine()  # it may have been set after construction
        number = len(observation["joints"])
        pieces = []
        for first in range(0, number, BLOCK):
            some = {name: part[first : first + BLOCK] for name, part in observation.items()}
            pieces.append(self._chosen(Problem.of_observation(some, self.task)))
        return np.concatenate(pieces)

    def _chosen(self, problem: Problem) -> Numbers:
        """Return the chosen actions of B problems, shape (B, m)."""
        actions, values = self.propose(problem)
        if not self.checks and not self.refine:
            first = self.best_within_reach(problem, actions, values)
            return np.asarray(actions[np.arange(len(first)), first])
        count = min(max(self.checks, self.refine), values.shape[1])
        local = max(count - PROPOSALS, 0) if self.checks else 0
        promising = self._promising(values, count - local)
        checked = np.take_along_axis(actions, promising[..., None], axis=1)
        if self.refine:
            refined = refined_actions(self.task, problem, self._apart(actions, values, self.refine))
            checked = np.concatenate((checked, refined), axis=1)
        worth = merits(self.task, problem, checked)
        best = best_of(self.task, problem, checked, worth)
        # Plans that are not clear have a merit near INFEASIBLE.
        rows = np.flatnonzero(self.replanning | (worth.max(axis=1) < 0.5 * INFEASIBLE))
        if local and rows.size:
            best[rows] = self._improved(problem.take(rows), checked[rows], worth[rows], local)
        return best

    def _improved(self, problem: Problem, checked: Numbers, worth: Numbers, count: int) -> Numbers:
        """Return the best of checked actions and of `count` further ones around the best of them, shape (B, m)."""
        for each in range(LOCAL_ROUNDS):
            share = (count + each) // LOCAL_ROUNDS
            if share:
                top = np.argsort(-worth, axis=1, kind="stable")[:, :4]
                near = self.around(np.take_along_axis(checked, top[..., None], axis=1), each)[:, :share]
                checked = np.concatenate((checked, near), axis=1)
                worth = np.concatenate((worth, merits(self.task, problem, near)), axis=1)
        return best_of(self.task, problem, checked, worth)

    def _promising(self, values: Numbers, count: int) -> NDArray[np.intp]:
        """Return indices of candidates to check, shape (B, count), for ranking criteria of shape (B, N).

        Refined candidates resemble each other, so at least half of the checks go to the best Sobol points.
        """
        if self.replanning:  # the action that keeps the plan is always checked, and first
            values = np.concatenate((np.full_like(values[:, :1], np.inf), values[:, 1:]), axis=1)
        refined = min(count // 2, values.shape[1] - self.candidates)
        spread = min(count - refined, self.candidates)
        first = np.argsort(-values[:, : self.candidates], axis=1, kind="stable")[:, :spread]
        last = np.argsort(-values[:, self.candidates :], axis=1, kind="stable")[:, :refined]
        return np.concatenate((first, last + self.candidates), axis=1)

    def _apart(self, actions: Numbers, values: Numbers, count: int) -> Numbers:
        """Return the best candidates that are APART from each other, shape (B, count, m).

        The planner's refinement would bring those that are close together to the same movement.
        """
        vias = actions[..., : self.task.n_via * self.task.action.dimension]
        left = values.copy()
        rows = np.arange(len(values))
        found = []
        for _ in range(count):
            best = left.argmax(axis=1)
            found.append(actions[rows, best])
            left[norm(vias - vias[rows, best][:, None]) < APART] = -np.inf
        return np.stack(found, axis=1)


def seen_ends(task: Task, problem: Problem) -> Float:
    """Return start, goal, distance and, in replanning tasks, the present motion, scaled to order one, shape (B, E).

    In hand space, velocity and acceleration are in the frame of the line from hand to goal.
    """
    scale = 2.0 if task.space.of_hand else 0.5
    line = problem.goal - problem.start
    ends = [scale * problem.start, scale * problem.goal, scale * norm(line)[:, None]]
    if problem.remaining is not None and problem.time_left is not None:
        for part, size in zip((problem.velocity, problem.acceleration), MOTION_SCALES, strict=True):
            if task.space.of_hand:
                mirrored = np.where(norm(line)[:, None] > 0.0, line * (1.0, -1.0), (1.0, 0.0))
                part = turned(part, mirrored)
            ends.append(size * part)
        ends += [problem.remaining[:, None], problem.time_left[:, None]]
    return np.concatenate(ends, axis=-1)


def _tensor(values: Any) -> Tensor:
    """Return a single-precision tensor; read-only arrays are copied."""
    return torch.from_numpy(np.require(values, dtype=np.float32, requirements=["C", "W"]))
