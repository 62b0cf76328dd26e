"""Parts that viaq and viarank share: policies that rank candidate plans, and the algorithms that train them."""

from __future__ import annotations

import inspect
import warnings
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BaseModel, BasePolicy
from stable_baselines3.common.utils import is_vectorized_observation
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import Tensor

from viapoint.envs.common.arrays import Observation
from viapoint.envs.common.validation import whole_number
from viapoint.envs.geometry.obstacles import no_obstacles
from viapoint.envs.task import Task
from viapoint.training.agents.agent import Agent, checked_observation
from viapoint.training.agents.model_io import LIMITS, check_arguments, check_same_task
from viapoint.training.agents.pairs import pairs_of
from viapoint.training.checks import unknown_name
from viapoint.training.planning.candidates import MOST_CANDIDATES, candidate_actions, normal_steps
from viapoint.training.planning.movements import FINE_INSTANTS
from viapoint.training.planning.problem import Numbers, Problem, moves_of
from viapoint.training.vec_env import check_spaces, check_unwrapped

N_ELITES = 8  # Number of candidates around which each round of refinement samples
# Standard deviation of the first round of refinement, in the action space; each round halves it
SPREAD = 0.15
# Number of candidates that are looked at together for one within reach, after the best one
LOOKED_AT = 32


class PlanPolicy(BasePolicy):
    """Policy without an actor: :meth:`decide` ranks candidate plans.

    Subclasses set their attributes, which are checked whenever they are set. `task` holds plain values, see
    :meth:`viapoint.envs.task.Task.as_dict`.
    """

    OWN: tuple[str, ...]  # Names of further arguments of the subclass, which become attributes
    candidates: int  # Number of Sobol points in the action space
    refinements: int  # Rounds of candidates around the best ones
    per_refinement: int  # Candidates of each round
    refine: int  # Number of best candidates that the planner refines

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        *,
        task: Mapping[str, Any],
        **kwargs: Any,
    ) -> None:
        for name in kwargs:
            if name not in inspect.signature(BaseModel).parameters:
                raise ValueError(unknown_name("policy_kwargs", name, self.OWN))
        super().__init__(observation_space, action_space, **kwargs)
        self.task = Task.of(**task)
        self.replanning = self.task.replanning

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; settings of the policy may change after training, too, and are checked each time."""
        if name in self.OWN:
            self._check_setting(name, value)
        super().__setattr__(name, value)

    def _check_setting(self, name: str, value: Any) -> None:
        """Check a setting; a wrong type, or a number out of range, raises ValueError."""
        check_arguments(type(self), {name: value})
        if name == "refine" and value and not self.can_refine:
            raise ValueError(f"refine must be 0 where plans are revised or have no via-points, got {value}")

    @property
    def all_candidates(self) -> int:
        """Number of candidates of a decision, those of all rounds among them."""
        return self.candidates + self.refinements * self.per_refinement

    @property
    def can_refine(self) -> bool:
        """True for tasks whose movements begin at rest and have via-points, which can be refined."""
        return not self.replanning and self.task.n_via > 0

    def _set_up(self, network: torch.nn.Module, lr_schedule: Any) -> None:
        """Check the number of candidates of a decision, and create the optimizer of the network."""
        whole_number("number of all candidates", self.all_candidates, 1, MOST_CANDIDATES)
        self.optimizer = self.optimizer_class(
            network.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in self.OWN}
        always = {"task": self.task.as_dict(), "lr_schedule": self._dummy_schedule}
        return {**super()._get_constructor_parameters(), **own, **always}

    def proposals(self, number: int, values: Callable[[Numbers], Numbers]) -> tuple[Numbers, Numbers]:
        """Return candidates of some problems, shape (B, N, m), and their values, shape (B, N); the first is zero.

        Each round of refinement adds candidates around the best ones so far.

        Args:
            number: Number of problems B.
            values: Function that returns the values of actions of shape (B, H, m), shape (B, H).
        """
        spread = candidate_actions(self.task, self.candidates, replanning=self.replanning)
        actions: Numbers = np.broadcast_to(spread, (number, *spread.shape))
        value = values(actions)
        for each in range(self.refinements):
            best = min(N_ELITES, actions.shape[1])
            top = np.argpartition(-value, best - 1, axis=1)[:, :best]
            elites = np.take_along_axis(actions, top[..., None], axis=1)
            centres = elites[:, np.arange(self.per_refinement) % best]
            steps = normal_steps(self.per_refinement, self.task.action.size, each) * (SPREAD * 0.5**each)
            some = np.clip(centres + steps, -1.0, 1.0).astype(np.float32)
            actions = np.concatenate((actions, some), axis=1)
            value = np.concatenate((value, values(some)), axis=1)
        return actions, value

    def best_within_reach(self, problem: Problem, actions: Numbers, values: Numbers) -> NDArray[np.intp]:
        """Return the index of the best of H actions in each of B problems, shape (B,), by values of shape (B, H).

        Movements from rest are looked at once more, as they will be executed: where kinematics says that the best one
        leaves reach or joint ranges, or that the arm touches itself, the best of those is taken that do not.
        """
        best = np.asarray(values.argmax(axis=1))
        rows = np.arange(0 if self.replanning else len(best))
        order = np.argsort(-values, axis=1, kind="stable")
        first, count = 0, 1
        while rows.size and first < order.shape[1]:
            some = order[rows, first : first + count]
            within = self._within_reach(problem.take(rows), actions[rows[:, None], some])
            found = within.any(axis=1)
            best[rows[found]] = some[found, within[found].argmax(axis=1)]
            rows = rows[~found]
            first += count
            # Candidates of a round are close together: where the best is out of reach, so are many of the next.
            count = LOOKED_AT
        return best

    def _within_reach(self, problem: Problem, actions: Numbers) -> NDArray[np.bool_]:
        """Return True, shape (B, H), for actions (B, H, m) with movements within reach and clear of the arm itself."""
        alone = problem._replace(obstacles=no_obstacles(len(actions)))
        moves = moves_of(self.task, alone, actions, exact=True)
        pairs = pairs_of(self.task, alone, moves, np.arange(FINE_INSTANTS), exact=True)
        return np.asarray(pairs.inside & (pairs.self_clearance > 0.0))

    @abstractmethod
    def decide(self, observation: Observation) -> Numbers:
        """Return the chosen actions, shape (B, m), for parts of B observations."""

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        arrays = {name: each.cpu().numpy() for name, each in observation.items()}
        return torch.as_tensor(self.decide(arrays), dtype=torch.float32, device=self.device)

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """Return actions for one observation or a batch, and no state, as policies of Stable-Baselines3 do.

        Raises:
            ValueError: The observation cannot be one of the task, see `checked_observation`.
        """
        parts: Any = self.observation_space
        arrays = checked_observation(observation, parts, self.task)
        several = is_vectorized_observation(cast(Any, arrays), parts)
        batch = {name: arrays[name].reshape(-1, *box.shape) for name, box in parts.spaces.items()}
        if not len(batch[next(iter(batch))]):
            return np.zeros((0, *cast(Any, self.action_space).shape), np.float32), state
        actions = np.clip(self.decide(batch), -1.0, 1.0).astype(np.float32)
        return (actions if several else actions[0]), state


class PlanAlgorithm(Agent, OffPolicyAlgorithm):
    """Off-policy algorithm that trains a policy that ranks plans.

    Subclasses set their own hyperparameters as attributes, and then call the constructor.
    """

    LARGEST_GRADIENT: float  # Norm to which gradients are clipped
    policy: Any

    def __init__(
        self,
        policy: Any,
        env: Any,
        learning_rate: Any,
        *,
        policy_kwargs: dict[str, Any] | None,
        buffer: type[ReplayBuffer],
        **kwargs: Any,
    ) -> None:
        if "replay_buffer_class" in kwargs:
            raise ValueError(
                f"{type(self).__name__} has a replay buffer of its own; leave replay_buffer_class out"
            )
        given = {**vars(self), "policy_kwargs": policy_kwargs, "learning_rate": learning_rate}
        given |= {name: value for name, value in kwargs.items() if name in LIMITS}
        check_arguments(type(self), given)
        super().__init__(
            policy,
            env,
            learning_rate,
            policy_kwargs=dict(policy_kwargs or {}),
            replay_buffer_class=buffer,
            support_multi_env=True,
            sde_support=False,
            **kwargs,
        )
        assert self.env is not None
        self.policy_kwargs.setdefault("task", self._task_of(self.env).as_dict())
        self._check_env(self.env)
        self._setup_model()

    def _task_of(self, env: VecEnv) -> Task:
        """Return the task of an environment, if the algorithm is made for it; ValueError otherwise."""
        try:
            (task,) = env.get_attr("task", indices=[0])
        except AttributeError:
            task = None
        if not isinstance(task, Task) or task.stepwise:
            raise ValueError(
                f"{type(self).__name__} needs an environment of this package in which an action is a whole movement, "
                "as in viapoint/PlanarObstacles-v0 and viapoint/PlanarSensed-v0; got "
                f"{'one with control steps' if isinstance(task, Task) else 'another one'}"
            )
        return task

    def _check_env(self, env: VecEnv) -> None:
        normalized = unwrap_vec_normalize(env)
        if normalized is not None and normalized.norm_obs:
            raise ValueError(
                f"{type(self).__name__} computes with metres: VecNormalize must be made with norm_obs=False"
            )
        check_unwrapped(env)
        check_same_task(Task.of(**self.policy_kwargs["task"]), self._task_of(env))

    def _setup_learn(self, *args: Any, **kwargs: Any) -> Any:
        total, callback = super()._setup_learn(*args, **kwargs)
        if total <= self.learning_starts:
            warnings.warn(
                f"the network is not updated once in {total} decisions, as learning starts after "
                f"{self.learning_starts} (learning_starts)",
                stacklevel=3,
            )
        return total, callback

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """Set the training environment.

        Raises:
            ValueError: Spaces, or parts of the task that the policy needs, differ from those of the agent.
        """
        wrapped = self._wrap_env(env, self.verbose)
        if self.env is not None:
            check_spaces(self.env, wrapped)
        self._check_env(wrapped)
        super().set_env(wrapped, force_reset)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update the network `gradient_steps` times."""
        policy = self.policy
        policy.set_training_mode(True)
        self._update_learning_rate(policy.optimizer)
        rows = []
        for _ in range(gradient_steps):
            losses = self._sampled_losses(batch_size)
            total: Any = sum(losses.values())
            policy.optimizer.zero_grad()
            total.backward()
            torch.nn.utils.clip_grad_norm_(policy.network.parameters(), self.LARGEST_GRADIENT)
            policy.optimizer.step()
            self._after_update()
            rows.append([float(loss.detach()) for loss in losses.values()])
            self._n_updates += 1
        for name, value in zip(losses, np.mean(rows, axis=0), strict=True):
            self.logger.record(f"train/{name}", float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    @abstractmethod
    def _sampled_losses(self, batch_size: int) -> dict[str, Tensor]:
        """Return the losses of sampled decisions or scenes, by their names in the log."""

    def _after_update(self) -> None:
        """Follow an update of the network."""

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
