"""Q-learning over candidate plans, with a critic that is a minimum over obstacles.

The algorithm extends :class:`OffPolicyAlgorithm` of Stable-Baselines3. There is no actor: the policy evaluates many
candidate actions with the critic and takes the best one, as QT-Opt does (Kalashnikov et al. 2018, arXiv 1806.10293).
The critic is regressed on the terms of the reward that `info` reports; training computes no distance to an obstacle.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor
from torch.nn import functional

from viapoint.envs.common.arrays import Single
from viapoint.envs.task import Task
from viapoint.primitives.array_api import Array
from viapoint.training.agents.model_io import ALGORITHMS
from viapoint.training.agents.plan_agent import PlanAlgorithm, task_in
from viapoint.training.agents.viaq_critic import Values
from viapoint.training.agents.viaq_policy import KEEP, ViaQPolicy
from viapoint.training.planning.candidates import candidate_actions
from viapoint.training.planning.problem import Problem
from viapoint.training.vec_env import ELAPSED, TERMS

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
        _init_setup_model: False to set up the networks later.
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
    replay_buffer: OutcomeReplayBuffer | None

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
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        self.explore_uniformly, self.temperature = explore_uniformly, temperature
        self.explore_candidates, self.next_candidates = explore_candidates, next_candidates
        super().__init__(
            policy,
            env,
            learning_rate,
            own=("explore_uniformly", "temperature", "explore_candidates", "next_candidates"),
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            gamma=gamma,
            gradient_steps=gradient_steps,
            replay_buffer_class=OutcomeReplayBuffer,
            policy_kwargs=policy_kwargs,
            train_freq=train_freq,
            tau=tau,
            _init_setup_model=_init_setup_model,
            **kwargs,
        )

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        before = self._last_obs
        prepared = super()._setup_learn(*args, **kwargs)
        if self._last_obs is not before and self.replay_buffer is not None:  # the environment was reset
            self.replay_buffer.begin()  # the running episodes are others
        return prepared

    def _task_of(self, env: VecEnv) -> Task:
        task = task_in(env)
        if task is None or task.stepwise:
            raise ValueError(
                "ViaQ needs an environment of this package in which an action is a whole movement, such as "
                f"viapoint/PlanarObstacles-v0; got {'another one' if task is None else 'one with control steps'}"
            )
        if task.sensor is not None:
            raise ValueError(
                "viaq needs the obstacles; where a sensor sees them, viarank learns to place via-points"
            )
        return task

    def _sampled_losses(self, batch_size: int) -> dict[str, Tensor]:
        assert self.replay_buffer is not None
        losses = self._losses(self.replay_buffer.sample_outcomes(batch_size))
        return {f"{name}_loss": loss for name, loss in losses.items()}

    def _after_update(self) -> None:
        target = self.policy.critic_target
        if target is not None:
            polyak_update(self.policy.critic.parameters(), target.parameters(), self.tau)
            target.pairs.largest.copy_(self.policy.critic.pairs.largest)

    def _losses(self, batch: OutcomeSamples) -> dict[str, Tensor]:
        """Return the losses of the predictions of the critic by name."""
        policy, critic = self.policy, self.policy.critic
        until = None
        if policy.replanning:
            # After a contact, the clearance is that of the movement up to the next decision.
            until = batch.elapsed + policy.task.horizon * (batch.outcomes.contact > 0.5)
            until = until[:, None].astype(np.float64)
        problem = Problem.of_observation(batch.observations, policy.task)
        inputs = policy.inputs(problem, batch.actions[:, None], until)
        critic.pairs.note_sizes(inputs.pairs)
        values = Values(*(each[:, 0] for each in critic(inputs)))
        following = self._following(batch)
        device = policy.device
        ended = torch.from_numpy(batch.ended).to(device)
        goes_on = (1.0 - ended) * self.gamma if following is not None else torch.zeros_like(ended)
        known = torch.from_numpy(np.isfinite(batch.outcomes.success)).to(device)
        outcomes = Outcomes(*(torch.from_numpy(each).nan_to_num().to(device) for each in batch.outcomes))
        contact, arrival, effort = outcomes.contact, outcomes.success, outcomes.effort_terms
        if following is not None:
            arrival = torch.where(ended > 0.5, arrival, self.gamma * torch.sigmoid(following.arrival))
            effort = effort + goes_on * following.effort_terms
        carried_out = known & ((contact + outcomes.success > 0.0) | (ended < 0.5))
        losses = {
            "clearance": self._clearance_loss(values, outcomes, known),
            "contact": CONTACT_WEIGHT * _mean(_cross_entropy(values.no_contact, 1.0 - contact), carried_out),
            "arrival": _mean(_cross_entropy(values.arrival, arrival), known & (contact < 0.5)),
            "effort": 10.0 * _mean(_smooth_l1(values.effort_terms, effort, beta=0.1), known),
        }
        if not bool(known.all()):
            target = torch.from_numpy(batch.reward).to(device)
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
        return _mean(_smooth_l1(apart, torch.zeros_like(apart), beta=0.2), known)

    @torch.no_grad()
    def _following(self, batch: OutcomeSamples) -> Values | None:
        """Return the predictions of the target critic for the best of a few candidates after each decision."""
        policy, critic = self.policy, self.policy.critic_target
        if critic is None or not self.gamma:
            return None
        every = candidate_actions(policy.task, policy.candidates, replanning=True)
        shape = len(batch.ended), self.next_candidates
        chosen = np.random.randint(min(1, len(every) - 1), len(every), size=shape)  # noqa: NPY002 - as SB3
        chosen[:, 0] = 0  # the action that keeps the plan
        values = critic(
            policy.inputs(Problem.of_observation(batch.next_observations, policy.task), every[chosen])
        )
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


class Outcomes(NamedTuple):
    """Outcomes of N decisions, shape (N,) each; NaN if the environment reports only the sum of the terms."""

    success: Array  # 1 for success, otherwise 0
    contact: Array  # 1 if the arm touched an obstacle, otherwise 0
    clearance: Array  # Clearance term of the reward, summed over the episode so far
    lower: Array  # 1 if this decision lowered that sum, so that no earlier decision accounts for it
    goal_error: Array  # Goal-error term of the reward
    effort_terms: Array  # Sum of the terms for smoothness and duration


class OutcomeSamples(NamedTuple):
    """Sampled decisions: B observations by name, actions of shape (B, m), all other fields of shape (B,)."""

    observations: dict[str, Single]
    actions: Single
    next_observations: dict[str, Single]
    ended: Single
    reward: Single
    # Duration of the executed part of the plan, [s]; infinite if the plan was executed to its end
    elapsed: Single
    outcomes: Outcomes


class OutcomeReplayBuffer(DictReplayBuffer):
    """Replay buffer for dictionary observations that stores the outcome of each decision from `info`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.optimize_memory_usage:
            raise ValueError("optimize_memory_usage must be False: the buffer stores the terms of the reward")
        self._begins = False
        self.elapsed = np.full((self.buffer_size, self.n_envs), np.inf, dtype=np.float32)
        self.outcomes = np.full(
            (self.buffer_size, self.n_envs, len(Outcomes._fields)), np.nan, dtype=np.float32
        )

    def add(
        self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]
    ) -> None:
        """Add one transition of each environment."""
        before = self._clearance_before()
        for i, info in enumerate(infos):
            self.elapsed[self.pos, i] = info.get(ELAPSED, np.inf)
            self.outcomes[self.pos, i] = outcome_of(info, float(reward[i]), before[i])
        super().add(obs, next_obs, action, reward, done, infos)

    def begin(self) -> None:
        """Mark the beginning of new episodes in all environments, after a reset."""
        self._begins = True

    def _clearance_before(self) -> Single:
        """Return the clearance terms summed over each running episode, shape (N,); NaN at its first decision."""
        begins, self._begins = self._begins, False
        if begins or (not self.pos and not self.full):
            return np.full(self.n_envs, np.nan, dtype=np.float32)
        last = self.pos - 1
        over = self.dones[last] > 0.5
        return np.where(over, np.nan, self.outcomes[last, :, Outcomes._fields.index("clearance")])

    def sample_outcomes(self, batch_size: int) -> OutcomeSamples:
        """Return `batch_size` decisions, sampled with replacement."""
        rows = np.random.randint(0, self.size(), size=batch_size)  # noqa: NPY002 - as SB3
        at = rows, np.random.randint(0, self.n_envs, size=batch_size)  # noqa: NPY002
        return OutcomeSamples(
            {name: part[at] for name, part in self.observations.items()},
            self.actions[at],
            {name: part[at] for name, part in self.next_observations.items()},
            np.asarray(self.dones[at] * (1.0 - self.timeouts[at]), dtype=np.float32),
            self.rewards[at],
            self.elapsed[at],
            Outcomes(*self.outcomes[at].T),
        )


def outcome_of(info: Mapping[str, Any], reward: float, before: float = np.nan) -> tuple[float, ...]:
    """Return the outcome that `info` reports, or NaN if its terms do not sum to the reward.

    The clearance terms of earlier decisions in the episode sum up to `before`; NaN for the first decision.
    """
    unknown = (np.nan,) * len(Outcomes._fields)
    if not all(name in info for name in TERMS):
        return unknown
    terms = [float(info[name]) for name in TERMS]
    if abs(sum(terms) - reward) > REWARD_TOLERANCE:
        return unknown
    success, collision, clearance, goal_error, smoothness, duration, _ = terms
    succeeded = bool(info.get("is_success", success > 0.0))
    contact = bool(info.get("collision", collision < 0.0))
    first = bool(np.isnan(before))
    lower = first or clearance < -LOWER
    so_far = clearance if first else before + clearance
    return float(succeeded), float(contact), so_far, float(lower), goal_error, smoothness + duration
