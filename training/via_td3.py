"""TD3 for decisions that are whole movements.

It differs from :class:`stable_baselines3.TD3` in what a movement allows. The critic sees the features of the planned
movement and learns only the part of the reward that no formula gives. The actor improves movements and learns on scenes
that are drawn but never simulated: what it makes of a movement climbs the critic's judgement, and what it foretells of
it regresses that. Where an episode is one decision, nothing is bootstrapped; where it is several, what follows a
decision counts as the critic judges it, and the actor learns on observations of the episodes themselves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import TD3
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import Tensor
from torch.nn import functional

from viapoint.envs.arms import ARMS
from viapoint.envs.step_episodes import StepRewardWeights
from viapoint.envs.task import Task
from viapoint.training.actor import ViaActor, arrays
from viapoint.training.features import Look
from viapoint.training.hyperparameters import check_hyperparameters, check_via_policy
from viapoint.training.movements import on_the_way
from viapoint.training.policies import Judgement, ViaCritic, ViaPolicy
from viapoint.training.scene_pool import Pool, ScenePool, VisitedPool

SHARPNESS = 8.0
"""How fast the probability of success falls with the learned part of the reward, about one half."""
OWN = (
    "explore_uniformly", "noise", "temperature", "promising", "others", "further", "fresh_scenes", "augment",
    "objective", "smoothness",
)  # fmt: skip
"""Settings that TD3 does not have."""
BOUND = ("arm", "whole_arm", "action", "weights")
"""Parts of a task that an agent cannot do without: it computes with them. Scenes of another kind are only others."""


class ViaTD3(TD3):
    """An off-policy learner of via-points.

    Args:
        policy: `ViaPolicy`.
        env: An environment of this package, or many.
        learning_rate: A number, or a function of the progress that remains.
        learning_starts: Decisions taken at random before anything is learnt.
        batch_size: Decisions of a critic's update, and scenes of an actor's.
        gradient_steps: Updates after each step of all environments.
        explore_uniformly: Share of decisions taken at random later on.
        noise: Standard deviation of what is added to the others.
        temperature: Difference of score that makes one of them e times as likely as another.
        promising: How many of the best-scored proposals of a scene, among a random half of them, an update looks at.
        others: And how many besides, drawn at random.
        further: How many of the promising ones are improved again.
        fresh_scenes: Scenes drawn for the actor after each step of all environments.
        augment: Whether their mirror images and exchanged ends join them.
        objective: What proposals climb: the expected reward, or the logarithm of the probability of success as the
            critic's learned part tells it, with the known effort.
        smoothness: Whether the objective counts the jerk of the movement.
        policy_kwargs: Of :class:`~viapoint.training.policies.ViaPolicy`; the task is asked of `env`.
        **kwargs: Of :class:`stable_baselines3.TD3`; noise, delay and target networks of it are not used.

    Raises:
        ValueError: A setting makes no sense, or the environment is not one that can be foreseen.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"ViaPolicy": ViaPolicy}
    policy: ViaPolicy
    actor: ViaActor  # type: ignore[assignment]
    critic: ViaCritic  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[ViaPolicy],
        env: Any,
        learning_rate: Any = 1e-3,
        *,
        learning_starts: int = 512,
        batch_size: int = 128,
        gradient_steps: int = 14,
        explore_uniformly: float = 0.25,
        noise: float = 0.05,
        temperature: float = 0.1,
        promising: int = 4,
        others: int = 2,
        further: int = 3,
        fresh_scenes: int = 64,
        augment: bool = True,
        objective: Literal["reward", "log_success"] = "reward",
        smoothness: bool = True,
        policy_kwargs: dict[str, Any] | None = None,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        self.explore_uniformly, self.noise, self.temperature = explore_uniformly, noise, temperature
        self.promising, self.others, self.further = promising, others, further
        self.fresh_scenes, self.augment = fresh_scenes, augment
        self.objective, self.smoothness = objective, smoothness
        check_hyperparameters("viatd3", _plain({name: getattr(self, name) for name in OWN}))
        check_via_policy(_plain(policy_kwargs or {}))
        kwargs = {"buffer_size": 50_000, "gamma": 0.0, "train_freq": 1, **kwargs}
        super().__init__(
            policy,
            env,
            learning_rate,
            learning_starts=learning_starts,
            batch_size=batch_size,
            gradient_steps=gradient_steps,
            policy_kwargs=dict(policy_kwargs or {}),
            _init_setup_model=False,
            **kwargs,
        )
        if self.env is not None:
            self.policy_kwargs.setdefault("task", task_of(self.env).as_dict())
        self.pool: Pool | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        if self.env is not None:
            self._take_on(self.env)
        super()._setup_model()

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """As its base class.

        Raises:
            ValueError: The environment is not one for this agent.
        """
        wrapped = self._wrap_env(env, self.verbose)
        check_for_correct_spaces(wrapped, self.observation_space, self.action_space)
        self._take_on(wrapped)
        super().set_env(wrapped, force_reset)

    def _take_on(self, env: VecEnv) -> None:
        """Refuse an environment that the agent was not made for; draw scenes from now on as it does."""
        mine, theirs = (
            task.as_dict() for task in (Task.from_dict(self.policy_kwargs["task"], ARMS), task_of(env))
        )
        others = [name for name in BOUND if mine[name] != theirs[name]]
        if others:
            raise ValueError(
                f"the environment must have the {', '.join(others)} that the agent was made for: "
                f"{ {name: mine[name] for name in others} }, got { {name: theirs[name] for name in others} }"
            )
        normalized = unwrap_vec_normalize(env)
        if normalized is not None and normalized.norm_obs:
            raise ValueError("ViaTD3 computes with metres: VecNormalize must be made with norm_obs=False")
        if not self.gamma and on_the_way(getattr(env.observation_space, "spaces", ())):
            raise ValueError(
                f"gamma must be more than 0 where episodes are several decisions, got {self.gamma}"
            )
        if mine["scenes"] != theirs["scenes"]:
            self.policy_kwargs = {**self.policy_kwargs, "task": theirs}
            self.pool = None

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """Update critic and actor `gradient_steps` times."""
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        self.pool = self.pool or self._new_pool()
        self.pool.begin(self._n_updates // gradient_steps)
        losses = []
        for _ in range(gradient_steps):
            self._n_updates += 1
            losses.append((self._update_critic(batch_size), *self._update_actor(batch_size)))
        names = ("critic_loss", "proposal_value", "score_loss")
        for name, value in zip(names, np.mean(losses, axis=0), strict=True):
            self.logger.record(f"train/{name}", float(value))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _new_pool(self) -> Pool:
        """What the actor learns on: scenes that are drawn, or where episodes have several decisions, visited ones."""
        task, seed = Task.from_dict(self.policy_kwargs["task"], ARMS), self.seed or 0
        if not self.gamma:
            return ScenePool(task, self.actor.look, seed, fresh=self.fresh_scenes, augment=self.augment)
        assert self.replay_buffer is not None
        return VisitedPool(
            self.replay_buffer, self.actor.look, seed, first=self.learning_starts // self.n_envs
        )

    def _update_critic(self, batch_size: int) -> float:
        """Regress what the formulas leave of the reward and of what follows."""
        assert self.replay_buffer is not None
        batch: Any = self.replay_buffer.sample(batch_size)
        judgement = self.critic.judge(batch.observations, batch.actions.unsqueeze(1))
        target = batch.rewards - judgement.known.total().detach()
        if self.gamma:
            discount = self.gamma if batch.discounts is None else batch.discounts
            target = target + (1.0 - batch.dones) * discount * self._value(batch.next_observations)
        loss = functional.smooth_l1_loss(judgement.learned, target, beta=0.5)
        self.critic.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.critic.parameters(), 10.0)
        self.critic.optimizer.step()
        return float(loss.item())

    @torch.no_grad()
    def _value(self, observation: Any) -> Tensor:
        """What is to come, shape (B, 1): the critic judges what the actor would choose among a few.

        A choice by the critic itself would prefer what it overestimates, and so many decisions to few.
        """
        look = self.actor.look_at(observation, self._few(observation))
        improved = self.actor.improve(self.actor.encode(observation), look)
        actions = torch.cat((look.actions[:, :1], improved.actions), dim=1)
        scores = torch.cat((improved.worth[:, :1] + look.known[:, :1], improved.promise), dim=1)
        chosen = actions[torch.arange(len(actions)), scores.argmax(dim=1)]
        value: Tensor = self.critic.judge(observation, chosen.unsqueeze(1)).reward()
        return value

    def _few(self, observation: Any) -> Tensor:
        """The first anchor in each scene, and as many others as an update looks at."""
        every = torch.as_tensor(self.actor.anchors.actions(arrays(observation)))
        number = every.shape[1]
        others = torch.randint(min(1, number - 1), number, (len(every), self.promising))
        some = torch.cat((torch.zeros_like(others[:, :1]), others), dim=1)
        return every[torch.arange(len(every)).unsqueeze(-1), some]

    def _update_actor(self, batch_size: int) -> tuple[float, float]:
        """Improve anchors, then what became of them, in the critic's judgement, and let the scores foretell it."""
        assert self.pool is not None
        observation, look = self.pool.sample(batch_size)
        scene = self.actor.encode(observation)
        first = self.actor.improve(scene, self._some_anchors(scene.detach(), look))
        ahead = first.promise[:, : self.promising]
        chosen = ahead.topk(min(self.further, ahead.shape[1]), dim=-1).indices
        rows = torch.arange(batch_size).unsqueeze(-1)
        again = (
            self.actor.look_at(observation, first.actions[rows, chosen]) if self.further else look.at(chosen)
        )
        second = self.actor.improve(scene, again)
        self.critic.requires_grad_(False)
        judgement = self.critic.judge(observation, torch.cat((first.actions, second.actions), dim=1))
        self.critic.requires_grad_(True)
        reward = judgement.reward().detach()
        foretold = torch.cat((first.promise, second.promise, second.worth), dim=1)
        targets = torch.cat((reward, judgement.learned.detach()[rows, chosen]), dim=1)
        score_loss = functional.smooth_l1_loss(foretold, targets, beta=0.5)
        loss = score_loss - self._merit(judgement).mean()
        self.actor.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.actor.parameters(), 10.0)
        self.actor.optimizer.step()
        return float(reward.amax(dim=1).mean().item()), float(score_loss.item())

    def _merit(self, judgement: Judgement) -> Tensor:
        """What proposals climb, shape (B, H)."""
        known = judgement.known
        effort: Tensor = known.duration + (known.smoothness if self.smoothness else 0.0)
        if self.objective == "log_success":
            return functional.logsigmoid(SHARPNESS * (judgement.learned - 0.5)) + effort
        merit: Tensor = judgement.learned + known.clearance + effort
        return merit

    def _some_anchors(self, scene: Tensor, look: Look) -> Look:
        """The most promising ones of a random half, and a few others."""
        batch_size, number = look.actions.shape[:2]
        promising = min(self.promising, number)
        look = look.at(torch.randperm(number)[: max(number // 2, promising)].expand(batch_size, -1))
        with torch.no_grad():
            most = self.actor.improve(scene, look).promise.topk(promising, dim=-1).indices
        others = torch.randint(0, look.actions.shape[1], (batch_size, self.others))
        return look.at(torch.cat((most, others), dim=-1))

    def _sample_action(
        self, learning_starts: int, action_noise: Any = None, n_envs: int = 1
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Random actions at first and for some environments always, noisy proposals for the others."""
        uniform = 2.0 * torch.rand((n_envs, self.actor.size)) - 1.0
        if self.num_timesteps < learning_starts:
            return uniform.numpy(), uniform.numpy()
        assert self._last_obs is not None
        with torch.no_grad():
            observation, _ = self.policy.obs_to_tensor(self._last_obs)
            proposals, scores = self.actor.propose(observation)  # type: ignore[arg-type]
            head = torch.multinomial(torch.softmax(scores / self.temperature, dim=-1), 1)[:, 0]
            chosen = proposals[torch.arange(n_envs), head]
            noisy = torch.clamp(chosen + self.noise * torch.randn_like(chosen), -1.0, 1.0)
            explore = torch.rand((n_envs, 1)) < self.explore_uniformly
            actions = torch.where(explore, uniform, noisy).numpy()
        return actions, actions

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "pool"]


def task_of(env: VecEnv) -> Task:
    """The task of an environment whose movements can be foreseen.

    Raises:
        ValueError: It is not one of this package, or an action is less than a movement.
    """
    try:
        task = env.get_attr("task", indices=0)[0]
    except AttributeError:
        task = None
    if not isinstance(task, Task) or isinstance(task.weights, StepRewardWeights):
        raise ValueError(
            "ViaTD3 needs an environment of this package in which an action is a whole movement, such as "
            f"viapoint/PlanarObstacles-v0, got {env.observation_space} with {env.action_space}"
        )
    return task


def _plain(settings: Mapping[str, Any]) -> dict[str, Any]:
    """With numbers of NumPy as those of Python."""
    return {name: each.item() if isinstance(each, np.generic) else each for name, each in settings.items()}
