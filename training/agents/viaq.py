"""Q-learning over candidate plans, with a critic that is a minimum over obstacles.

The algorithm extends :class:`OffPolicyAlgorithm` of Stable-Baselines3. There is no actor: the policy evaluates many
candidate actions with the critic and takes the best one, as QT-Opt does (Kalashnikov et al. 2018, arXiv 1806.10293),
after exact checks or refinement of the best ones where they are asked for. The critic is regressed on the terms of the
reward that `info` reports; training computes no distance to an obstacle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.nn import functional
from torch.utils._pytree import tree_leaves, tree_map

from viapoint.envs.common.arrays import Float, Observation, norm
from viapoint.envs.outcome import SETTLING
from viapoint.envs.plans import turned
from viapoint.envs.rewards import CLEARANCE_RANGE, CLEARANCE_UNIT, TERMS
from viapoint.envs.task import Task
from viapoint.primitives.array_api import Array
from viapoint.training.agents.model_io import ALGORITHMS
from viapoint.training.agents.pairs import PairNetwork, Pairs, pairs_of
from viapoint.training.agents.plan_agent import PlanAlgorithm, PlanPolicy
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.movements import INSTANTS
from viapoint.training.planning.problem import Numbers, Problem, moves_of
from viapoint.training.planning.search import best_of, merits, refined_actions
from viapoint.training.vec_env import ELAPSED

# Weight of a clearance that was predicted too high, where one that was too low has 1: the policy takes the best of many
# predictions, among which those that are too high gather (an asymmetric loss, as in expectile regression).
TOO_HIGH = 4.0
KEEP = 0.1  # Minimum gain of Q for which a running plan is revised
# Least distance of the via-points of two candidates that are refined, in the action space. Of .2 to 1.8, .5 solved most
# of the `validation` scenes of PandaObstacles.
APART = 0.5
SPARE = 0.2  # Greatest time that is left after a movement, or missing for it, at the input of the critic, [s]
BLOCK = 64  # Scenes that are decided together
MOTION_SCALES = (1.0, 0.1)  # Scales of velocity and acceleration at the input of the critic
# Unit of errors of the clearance term, as a share of the weight of the term: 2 cm
CLEARANCE_SCALE = 0.4
# Share of the weight of the clearance term by which the obstacles must be nearer than the arm itself: 1 mm
OWN_SHARE = 0.02
KEEP_PROBABILITY = 0.5  # Probability that a random decision in a replanning task keeps the plan
# Weight of the contact loss; the clearance loss carries finer information on the same event
CONTACT_WEIGHT = 0.1
LOWER = 1e-6  # Smallest decrease of the clearance term that counts as a decrease
# Largest difference between the reward and the sum of its terms that counts as rounding
REWARD_TOLERANCE = 1e-4
# Number of effort features: log jerk, duration, log duration, and spare time if time is limited
EFFORT = 4
IN_TIME = 20.0  # Logits of arrival for each second of spare time in tasks with a time limit, [1/s]
# Logits of arrival that a movement beyond reach or joint ranges loses: it is not executed
OUTSIDE = 1000.0
# Penalty on the merit of plans that are unlikely to succeed; larger than the range of Q
UNLIKELY = 10.0


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
        instants: int = INSTANTS,
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
        self.critic = ViaQCritic(self.task, width=self.width)
        self.critic_target: ViaQCritic | None = None
        if self.replanning:  # values of later decisions are learned from a critic that changes slowly
            self.critic_target = ViaQCritic(self.task, width=self.width)
            self.critic_target.load_state_dict(self.critic.state_dict())
            self.critic_target.requires_grad_(False)
        self._set_up(self.critic, lr_schedule)

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
        instants = np.linspace(0, INSTANTS - 1, self.instants).round().astype(np.int64)
        pairs = pairs_of(self.task, problem, moves, instants, until)
        ends = seen_ends(self.task, problem)
        return PlanInputs(_tensor(ends), _tensor(actions), _tensor(effort), pairs)

    @torch.inference_mode()
    def values(self, problem: Problem, actions: Numbers) -> Numbers:
        """Return the ranking criterion of H actions in each of B problems, shape (B, H); see :meth:`ViaQCritic.merit`.

        In replanning tasks a first action of zero, which keeps the plan, gets a bonus of KEEP.
        """
        found = self.critic(self.inputs(problem, actions).to(self.device))
        values: Numbers = self.critic.merit(found).cpu().numpy()
        if self.replanning:
            values[:, 0] += np.where((actions[:, 0] == 0.0).all(axis=-1), KEEP, 0.0)
        return values

    def propose(self, problem: Problem) -> tuple[Numbers, Numbers]:
        """Return candidates, shape (B, N, m), and their ranking criterion, shape (B, N); the first is zero."""
        return self.proposals(len(problem.start), lambda actions: self.values(problem, actions))

    def decide(self, observation: Observation) -> Numbers:
        """Return the chosen actions, shape (B, m), for B observations, arrays by name."""
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
        promising = self._promising(values, max(self.checks, self.refine))
        checked = np.take_along_axis(actions, promising[..., None], axis=1)
        if self.refine:
            refined = refined_actions(self.task, problem, self._apart(actions, values, self.refine))
            checked = np.concatenate((checked, refined), axis=1)
        return best_of(self.task, problem, checked, merits(self.task, problem, checked))

    def _promising(self, values: Numbers, count: int) -> NDArray[np.intp]:
        """Return indices of candidates to check, shape (B, count), for ranking criteria of shape (B, N).

        Refined candidates resemble each other, so they take turns with the best Sobol points.
        """
        if self.replanning:  # the action that keeps the plan is always checked, and first
            values[:, 0] = np.inf
        rank = np.empty_like(values)
        for part in (slice(self.candidates), slice(self.candidates, None)):
            order = np.argsort(-values[:, part], axis=1, kind="stable")
            rank[:, part] = order.argsort(axis=1)
        return np.argsort(rank, axis=1, kind="stable")[:, :count]

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


class ViaQ(PlanAlgorithm):
    """Off-policy algorithm that chooses via-points by ranking candidate plans.

    Args:
        policy: `ViaQPolicy`.
        env: Environment or vector environment of this package whose actions are whole movements.
        learning_rate: Learning rate, or a function of the remaining progress.
        buffer_size: Capacity of the replay buffer, in decisions.
        learning_starts: Number of random decisions before the first update.
        batch_size: Decisions in each update.
        gamma: Discount of the value after a decision; without effect if an episode is one decision.
        gradient_steps: Updates after each step of all environments.
        explore_uniformly: Probability of a random action after `learning_starts`.
        temperature: Temperature of the softmax of Q over candidates.
        explore_candidates: Candidates of each decision during training.
        next_candidates: Candidates over which the value of the next observation is maximised.
        train_freq: Steps of all environments between two rounds of updates.
        tau: Rate at which the target critic follows, in tasks with replanning.
        policy_kwargs: Arguments of :class:`ViaQPolicy`; `env` provides the task.
        **kwargs: Arguments that all algorithms of Stable-Baselines3 have, such as `seed`, `device`, `verbose` and
            `tensorboard_log`.

    Raises:
        ValueError: A hyperparameter is out of range, or the environment has no task of this package.

    Example:
        >>> from viapoint.training import ViaQ, ViaVecEnv
        >>> agent = ViaQ("ViaQPolicy", ViaVecEnv("viapoint/PlanarObstacles-v0", 64, seed=0), learning_starts=64)
        >>> agent = agent.learn(128)
        >>> agent.num_timesteps
        128
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"ViaQPolicy": ViaQPolicy}
    LARGEST_GRADIENT = 10.0
    policy: ViaQPolicy
    replay_buffer: OutcomeReplayBuffer

    def __init__(
        self,
        policy: str | type[ViaQPolicy],
        env: Any,
        learning_rate: float | Schedule = 3e-3,
        *,
        buffer_size: int = 50_000,
        learning_starts: int = 4_096,
        batch_size: int = 256,
        gamma: float = 1.0,
        gradient_steps: int = 16,
        explore_uniformly: float = 0.25,
        temperature: float = 0.1,
        explore_candidates: int = 32,
        next_candidates: int = 8,
        train_freq: int | tuple[int, str] = 1,
        tau: float = 0.005,
        policy_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        self.explore_uniformly = explore_uniformly
        self.temperature = temperature
        self.explore_candidates = explore_candidates
        self.next_candidates = next_candidates
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            gamma=gamma,
            gradient_steps=gradient_steps,
            buffer=OutcomeReplayBuffer,
            policy_kwargs=policy_kwargs,
            train_freq=train_freq,
            tau=tau,
            **kwargs,
        )

    def _task_of(self, env: VecEnv) -> Task:
        task = super()._task_of(env)
        if task.sensor is not None:
            raise ValueError(
                "viaq needs the obstacles; where a sensor sees them, viarank learns to place via-points"
            )
        return task

    def _sampled_losses(self, batch_size: int) -> dict[str, Tensor]:
        losses = self._losses(self.replay_buffer.sample_places(batch_size))
        return {f"{name}_loss": loss for name, loss in losses.items()}

    def _after_update(self) -> None:
        target = self.policy.critic_target
        if target is not None:
            polyak_update(self.policy.critic.parameters(), target.parameters(), self.tau)
            target.pairs.largest.copy_(self.policy.critic.pairs.largest)

    def _losses(self, at: At) -> dict[str, Tensor]:
        """Return the losses of the predictions of the critic for stored decisions by name."""
        policy, critic, buffer = self.policy, self.policy.critic, self.replay_buffer
        device = policy.device
        inputs = buffer.plans(at, self._inputs).to(device)
        critic.pairs.note_sizes(inputs.pairs)
        values = Values(*(each[:, 0] for each in critic(inputs)))
        following = self._following(at)
        ended = torch.from_numpy(buffer.dones[at] * (1.0 - buffer.timeouts[at])).to(device)
        goes_on = (1.0 - ended) * self.gamma if following is not None else torch.zeros_like(ended)
        reported = torch.from_numpy(buffer.outcomes[at].T).to(device)
        outcomes = Outcomes(*reported.nan_to_num())
        known = torch.isfinite(reported[0])
        contact, arrival, effort = outcomes.contact, outcomes.success, outcomes.effort_terms
        if following is not None:
            arrival = torch.where(ended > 0.5, arrival, self.gamma * torch.sigmoid(following.arrival))
            effort = effort + goes_on * following.effort_terms
        went_on = known & ((outcomes.success > 0.5) | (ended < 0.5))
        carried_out = went_on | (known & (contact > 0.5))
        # A movement that stops early takes less effort than its plan, so that failures would make rough plans cheap.
        # Where plans are revised, they count: without them, nothing ties down the values of later decisions.
        effort_counts = known if policy.replanning else went_on
        losses = {
            "clearance": self._clearance_loss(values, outcomes, known),
            "contact": CONTACT_WEIGHT * _mean(_cross_entropy(values.no_contact, 1.0 - contact), carried_out),
            "arrival": _mean(_cross_entropy(values.arrival, arrival), known & (contact < 0.5)),
            "effort": 10.0 * _mean(_smooth_l1(values.effort_terms, effort, beta=0.1), effort_counts),
        }
        if not bool(known.all()):
            target = torch.from_numpy(buffer.rewards[at]).to(device)
            if following is not None:
                target = target + goes_on * critic.value(following).detach()
            losses["reward"] = _mean(_smooth_l1(critic.value(values), target, beta=0.2), ~known)
        return losses

    def _clearance_loss(self, values: Values, outcomes: Outcomes, known: Tensor) -> Tensor:
        """Return the loss of the predicted clearance of the executed part of each plan.

        The environment reports the lowest clearance of the episode so far. If an earlier decision or the arm itself set
        it, it is a lower bound for the obstacles, and only predictions below it count as errors.
        """
        weight = max(float(self.policy.task.weights.clearance), 1e-3)
        critic = self.policy.critic
        apart = (critic.clearance_term(values.margin) - outcomes.clearance) / (CLEARANCE_SCALE * weight)
        own = critic.clearance_term(values.self_clearance).detach()
        obstacles = (outcomes.lower > 0.5) & (outcomes.clearance < own - OWN_SHARE * weight)
        apart = torch.where(obstacles, apart, apart.clamp(max=0.0))
        weight_of_error = torch.where(apart > 0.0, TOO_HIGH, 1.0)
        return _mean(weight_of_error * _smooth_l1(apart, torch.zeros_like(apart), beta=0.2), known)

    def _inputs(self, at: At) -> PlanInputs:
        """Return the critic's inputs for stored decisions."""
        policy, buffer = self.policy, self.replay_buffer
        until = None
        if policy.replanning:
            # After a contact, the clearance is that of the movement up to the next decision.
            contact = buffer.outcomes[at][:, Outcomes._fields.index("contact")] > 0.5
            until = (buffer.elapsed[at] + policy.task.horizon * contact)[:, None].astype(np.float64)
        observations = {name: part[at] for name, part in buffer.observations.items()}
        problem = Problem.of_observation(observations, policy.task)
        return policy.inputs(problem, buffer.actions[at][:, None], until)

    def _next_inputs(self, at: At) -> PlanInputs:
        """Return the critic's inputs for a few candidates after stored decisions; the first one keeps the plan."""
        policy, buffer = self.policy, self.replay_buffer
        every = candidate_actions(policy.task, policy.candidates, replanning=True)
        number = at[0] * buffer.n_envs + at[1]  # other candidates for each decision, but always the same
        chosen = (number[:, None] * self.next_candidates + np.arange(self.next_candidates)) % len(every)
        chosen[:, 0] = 0
        observations = {name: part[at] for name, part in buffer.next_observations.items()}
        return policy.inputs(Problem.of_observation(observations, policy.task), every[chosen])

    @torch.no_grad()
    def _following(self, at: At) -> Values | None:
        """Return the predictions of the target critic for the best of a few candidates after stored decisions."""
        critic = self.policy.critic_target
        if critic is None:
            return None
        values = critic(self.replay_buffer.next_plans(at, self._next_inputs).to(self.policy.device))
        worth = critic.value(values)
        worth[:, 0] += KEEP  # as the policy prefers it
        best = worth.argmax(dim=1, keepdim=True)
        return Values(*(each.gather(1, best)[:, 0] for each in values))

    def _sample_action(
        self, learning_starts: int, action_noise: Any = None, n_envs: int = 1
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Sample actions: uniform ones at first and for some environments, otherwise candidates by their softmax."""
        size = self.policy.task.action.size
        uniform = np.random.uniform(-1.0, 1.0, (n_envs, size)).astype(np.float32)  # noqa: NPY002 - seeded by SB3
        if self.policy.replanning:  # random revisions at every decision hardly ever reach the goal
            uniform[np.random.uniform(size=n_envs) < KEEP_PROBABILITY] = 0.0  # noqa: NPY002
        if self.num_timesteps < learning_starts:
            return uniform, uniform
        observation: Any = self._last_obs
        candidates = np.random.uniform(-1.0, 1.0, (n_envs, self.explore_candidates, size))  # noqa: NPY002
        candidates[:, 0] = 0.0
        candidates = candidates.astype(np.float32)
        values = self.policy.values(Problem.of_observation(observation, self.policy.task), candidates)
        values = values / self.temperature
        # The argmax of values plus Gumbel noise is a sample of their softmax (Gumbel-max trick).
        noisy = values + np.random.gumbel(size=values.shape)  # noqa: NPY002
        chosen = candidates[np.arange(n_envs), noisy.argmax(axis=1)]
        explore = np.random.uniform(size=(n_envs, 1)) < self.explore_uniformly  # noqa: NPY002
        actions = np.where(explore, uniform, chosen).astype(np.float32)
        return actions, actions


def _mean(losses: Tensor, counted: Tensor) -> Tensor:
    """Return the mean over all rows, with zero for rows that are not counted."""
    return (losses * counted).mean()


def _cross_entropy(logits: Tensor, target: Tensor) -> Tensor:
    return functional.binary_cross_entropy_with_logits(logits, target, reduction="none")


def _smooth_l1(values: Tensor, target: Tensor, beta: float) -> Tensor:
    return functional.smooth_l1_loss(values, target, beta=beta, reduction="none")


ALGORITHMS["viaq"] = ViaQ


At = tuple[NDArray[np.int64], NDArray[np.int64]]  # Rows of a replay buffer, and environments, shape (B,) each


class Outcomes(NamedTuple):
    """Outcomes of N decisions, shape (N,) each; NaN if the environment reports only the sum of the terms."""

    success: Array  # 1 for success, otherwise 0
    contact: Array  # 1 if the arm touched an obstacle, otherwise 0
    clearance: Array  # Clearance term of the reward, summed over the episode so far
    lower: Array  # 1 if this decision lowered that sum, so that no earlier decision accounts for it
    effort_terms: Array  # Sum of the terms for smoothness and duration


class SeenPlans:
    """Critic's inputs for stored decisions, computed once for each of them, as many updates learn from it.

    Args:
        shape: Numbers of rows and of environments of a replay buffer.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self.known = np.zeros(shape, np.bool_)
        self._inputs: PlanInputs | None = None

    def __call__(self, at: At, look: Callable[[At], PlanInputs]) -> PlanInputs:
        """Return the inputs for some decisions; `look` computes those that are not known yet."""
        new = ~self.known[at]
        if new.any():
            some = at[0][new], at[1][new]
            found = look(some)
            if self._inputs is None:  # room for the inputs of all decisions
                shape = self.known.shape
                self._inputs = tree_map(lambda part: part.new_zeros((*shape, *part.shape[1:])), found)
            for kept, part in zip(tree_leaves(self._inputs), tree_leaves(found), strict=True):
                kept[some] = part
            self.known[some] = True
        inputs: PlanInputs = tree_map(lambda kept: kept[at], self._inputs)
        return inputs


class OutcomeReplayBuffer(DictReplayBuffer):
    """Replay buffer for dictionary observations that stores the outcome of each decision from `info`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.elapsed = np.full((self.buffer_size, self.n_envs), np.inf, dtype=np.float32)
        self.outcomes = np.full(
            (self.buffer_size, self.n_envs, len(Outcomes._fields)), np.nan, dtype=np.float32
        )
        # Of the decisions, and of candidates after them
        self.plans, self.next_plans = (SeenPlans((self.buffer_size, self.n_envs)) for _ in range(2))

    def add(
        self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]
    ) -> None:
        """Add one transition of each environment."""
        before = self.outcomes[self.pos - 1, :, Outcomes._fields.index("clearance")]
        for i, info in enumerate(infos):
            self.elapsed[self.pos, i] = info.get(ELAPSED, np.inf)
            first = info.get("time") == info.get(ELAPSED)  # nothing was decided before in this episode
            so_far = np.nan if first else before[i]
            self.outcomes[self.pos, i] = outcome_of(info, float(reward[i]), so_far)
        for seen in (self.plans, self.next_plans):
            seen.known[self.pos] = False
        super().add(obs, next_obs, action, reward, done, infos)

    def sample_places(self, batch_size: int) -> At:
        """Return the places of `batch_size` decisions, sampled with replacement."""
        rows = np.random.randint(0, self.size(), size=batch_size)  # noqa: NPY002 - as SB3
        return rows, np.random.randint(0, self.n_envs, size=batch_size)  # noqa: NPY002


def outcome_of(info: Mapping[str, Any], reward: float, before: float = np.nan) -> tuple[float, ...]:
    """Return the outcome that `info` reports, or NaN if its terms do not sum to the reward.

    The clearance terms of earlier decisions in the episode sum up to `before`; NaN for the first decision.
    """
    terms = [float(info.get(name, np.nan)) for name in TERMS]
    if not abs(sum(terms) - reward) <= REWARD_TOLERANCE:  # also where a term is missing
        return (np.nan,) * len(Outcomes._fields)
    _, _, clearance, _, smoothness, duration, _ = terms
    first = bool(np.isnan(before))
    lower = first or clearance < -LOWER
    so_far = clearance if first else before + clearance
    effort = smoothness + duration
    return float(info["is_success"]), float(info["collision"]), so_far, float(lower), effort


class Values(NamedTuple):
    """Predictions of the critic for H plans in each of B scenes, shape (B, H) each."""

    margin: Tensor  # Predicted clearance from obstacles, [m]
    self_clearance: Tensor  # Computed clearance of the arm from itself, [m]
    no_contact: Tensor  # Logit of the probability of no contact
    arrival: Tensor  # Logit of the probability of success given no contact
    clearance: Tensor  # Predicted clearance term of the reward
    effort_terms: Tensor  # Predicted sum of the terms for smoothness and duration


class PlanInputs(NamedTuple):
    """Inputs of the critic for H plans in each of B scenes."""

    ends: Tensor  # Start, goal and, in replanning tasks, the present motion, shape (B, E)
    actions: Tensor  # Shape (B, H, m)
    effort: Tensor  # Shape (B, H, EFFORT)
    pairs: Pairs  # Nearest pairs of spheres and obstacles

    def to(self, device: torch.device) -> PlanInputs:
        """Return the same inputs on a device; geometry is computed on the processor, networks may be elsewhere."""
        moved: PlanInputs = tree_map(lambda part: part.to(device), self)
        return moved


class _Saturated(torch.autograd.Function):
    """Clamp whose gradient can move values back into the range, but not farther out of it."""

    @staticmethod
    def forward(context: Any, values: Tensor, low: float, high: float) -> Tensor:
        context.save_for_backward(values)
        context.bounds = low, high
        return values.clamp(low, high)

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (values,), (low, high) = context.saved_tensors, context.bounds
        outwards = ((values > high) & (gradient < 0.0)) | ((values < low) & (gradient > 0.0))
        return torch.where(outwards, 0.0, gradient), None, None


class ViaQCritic(nn.Module):
    """Network that predicts the value of plans from their margin and effort.

    The margin m(s, a) is learned (see :mod:`viapoint.training.agents.pairs`). Kinematics says whether the movement
    stays within reach and joint ranges, and how far the arm is from itself, o(s, a):

        P(clear) = sigmoid(k m + b) sigmoid(k' o + b'),  P(success) = P(clear) sigmoid(l + c(s, a)),
        Q(s, a) = w_s P(success) - w_c (1 - P(clear)) - w_g (1 - P(success)) + w_m clip(min(m, o)) + e(s, a)

    Args:
        task: Task of the environment.
        width: Width of the hidden layers of the pair network.
    """

    def __init__(self, task: Task, *, width: int) -> None:
        super().__init__()
        dimension, size = task.space.dimension, task.action.size
        ends = (4 * dimension + 3) if task.replanning else (2 * dimension + 1)
        self.replanning = task.replanning
        self.pairs = PairNetwork(task.shapes, width)
        self.arrival = nn.Parameter(torch.tensor(2.0))  # Logit l of arrival of a movement within reach
        self.rest = nn.Sequential(*create_mlp(ends + EFFORT + (0 if task.replanning else size), 2, [64, 64]))
        for parameter in self.rest[-1].parameters():
            nn.init.zeros_(parameter)
        weights = task.weights
        self.linear = nn.Parameter(torch.tensor([-weights.smoothness, -weights.duration, 0.0, 0.0]))
        """Weights of the effort features, initialised from the reward weights."""
        self.slope = nn.Parameter(torch.tensor([6.0, 0.0]))  # Logarithm of k [1/m], and b
        self.self_slope = nn.Parameter(torch.tensor([6.0, 2.0]))  # Logarithm of k' [1/m], and b'
        self.scales = nn.Parameter(
            torch.tensor([weights.success, weights.collision, weights.goal_error, weights.clearance])
        )
        """w_s, w_c, w_g and w_m, initialised from the reward weights and adapted to the rewards."""

    def forward(self, inputs: PlanInputs) -> Values:
        """Return the predictions for each plan."""
        margin, own = self.pairs(inputs.pairs), inputs.pairs.self_clearance
        reach = self.arrival - OUTSIDE * (~inputs.pairs.inside).to(margin.dtype)
        # Keeping a plan and planning the same movement again have the same value, so the action itself is not an input.
        ends = inputs.ends[:, None].expand(-1, inputs.actions.shape[1], -1)
        known = ends if self.replanning else torch.cat((ends, inputs.actions), dim=-1)
        rest = self.rest(torch.cat((known, inputs.effort), dim=-1))
        obstacles = margin * torch.exp(self.slope[0]) + self.slope[1]
        itself = own * torch.exp(self.self_slope[0]) + self.self_slope[1]
        return Values(
            margin,
            own,
            both(obstacles, itself),
            reach + rest[..., 1] + IN_TIME * inputs.effort[..., 3],
            torch.minimum(self.clearance_term(margin), self.clearance_term(own)),
            rest[..., 0] + inputs.effort @ self.linear,
        )

    def clearance_term(self, clearance: Tensor) -> Tensor:
        """Return the clearance term of the reward for a clearance, [m]."""
        low, high = CLEARANCE_RANGE
        clip: Any = _Saturated.apply
        term: Tensor = clip(clearance, low, high) * (self.scales[3] / CLEARANCE_UNIT)
        return term

    def value(self, values: Values) -> Tensor:
        """Return Q, shape (B, H)."""
        clear = torch.sigmoid(values.no_contact)
        success = clear * torch.sigmoid(values.arrival)
        won, lost, missed, _ = self.scales
        total: Tensor = won * success - lost * (1.0 - clear) - missed * (1.0 - success)
        return total + values.clearance + values.effort_terms

    def merit(self, values: Values) -> Tensor:
        """Return the ranking criterion, shape (B, H): Q if success is more likely than not, otherwise a lower number.

        If no plan is likely to succeed, Q prefers plans out of reach, which are not executed and so touch nothing. The
        logarithm of the probability of success ranks such plans instead; the probability itself may round to 0.
        """
        log = functional.logsigmoid(values.no_contact) + functional.logsigmoid(values.arrival)
        merit: Tensor = torch.where(log > np.log(0.5), self.value(values), log - UNLIKELY)
        return merit


def both(first: Tensor, second: Tensor) -> Tensor:
    """Return the logit of the product of two probabilities that are given as logits."""
    log = functional.logsigmoid(first) + functional.logsigmoid(second)
    log = log.clamp(max=-1e-6)
    return log - torch.log(-torch.expm1(log))
