"""A critic that foresees the movement, and the policy of actor and critic."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.td3.policies import TD3Policy
from torch import Tensor, nn

from viapoint.envs.arms import ARMS
from viapoint.envs.task import Task
from viapoint.training import graphs
from viapoint.training.actor import ViaActor, arrays, best, most, tensors
from viapoint.training.features import (
    GEOMETRY,
    Foresight,
    KnownReward,
    Look,
    SceneView,
    foresee,
    scene_sizes,
    scene_view,
)
from viapoint.training.movements import on_the_way
from viapoint.training.set_encoder import SetEncoder, layers
from viapoint.training.sight import Observation, Sight


class Judgement(NamedTuple):
    """What to expect of H actions in each of B scenes."""

    learned: Tensor
    """The part of the reward that no formula gives, shape (B, H)."""
    known: KnownReward

    def reward(self) -> Tensor:
        """The expected reward, shape (B, H)."""
        return cast(Tensor, self.learned + self.known.total())


class ViaCritic(BaseModel):
    """What the physics will make of an action: the part of the reward that no formula gives.

    It sees action, scene and the features of the planned movement.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        *,
        task: Task,
        width: int,
        trajectory_features: bool = True,
    ) -> None:
        super().__init__(observation_space, action_space)
        self.task, self.sighted = task, trajectory_features
        self.encoder = SetEncoder(*scene_sizes(observation_space.spaces, task), width // 4)
        self.scene = nn.Linear(self.encoder.size, width)
        self.movement = nn.Linear(GEOMETRY + 1 + get_action_dim(action_space), width, bias=False)
        self.value = nn.Sequential(nn.ReLU(), layers(width, width), nn.Linear(width, 1))

    def judge(self, observation: Observation, actions: Tensor) -> Judgement:
        """What to expect of H actions in each of B scenes, shape (B, H)."""
        view = SceneView(*tensors(scene_view(arrays(observation), self.task), self.scene.weight))
        foresight = self.foresee(observation, actions)
        learned, known = self.learned(view, foresight.vector(), actions), foresight.reward
        if not self.sighted:
            known = known._replace(clearance=torch.zeros_like(learned))
        return Judgement(learned, known)

    def learned(self, view: SceneView, features: Tensor, actions: Tensor) -> Tensor:
        """The part that no formula gives, of scenes and movements that are seen already, shape (B, H)."""
        features = features if self.sighted else torch.zeros_like(features)
        scene = self.scene(self.encoder(view)).unsqueeze(1)
        learned: Tensor = self.value(scene + self.movement(torch.cat((features, actions), dim=-1)))
        return learned.squeeze(-1)

    def foresee(self, observation: Observation, actions: Tensor) -> Foresight:
        """In torch where gradients are asked for, otherwise in NumPy, which deals with small arrays faster."""
        if graphs.is_drawn() or (actions.requires_grad and torch.is_grad_enabled()):
            return foresee(observation, actions, self.task)
        known = foresee(arrays(observation), actions.detach().cpu().numpy(), self.task)
        seen, reward = (tensors(part, self.scene.weight) for part in (known.seen, known.reward))
        (log_jerk,) = tensors([known.log_jerk], self.scene.weight)
        return Foresight(Sight(*seen), log_jerk, KnownReward(*reward))

    def forward(self, observation: Observation, actions: Tensor) -> tuple[Tensor]:
        """The expected reward of one action in each scene, shape (B, 1), as SB3's critics return it."""
        return (self.judge(observation, actions.unsqueeze(1)).reward(),)


class ViaPolicy(TD3Policy):
    """Actor and critic of :class:`~viapoint.training.via_td3.ViaTD3`.

    Args:
        observation_space: Of the environment.
        action_space: Of the environment.
        lr_schedule: Learning rate against the progress that remains.
        task: The environment's task as plain values, see :meth:`viapoint.envs.task.Task.as_dict`.
        width: Of the hidden layers.
        rounds: How often the actor improves its movements.
        kept: How many of the most promising ones go from each round to the next.
        candidates: How many movements the critic ranks at each decision; 0 takes the actor's own choice.
        heads: With how many anchors the actor begins; all if None, the straight movement if 1.
        trajectory_features: Whether actor and critic see how movements would fare.
    """

    actor: ViaActor  # type: ignore[assignment]
    critic: ViaCritic  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        lr_schedule: Any,
        *,
        task: dict[str, Any],
        width: int = 176,
        rounds: int = 2,
        kept: int = 6,
        candidates: int = 0,
        heads: int | None = None,
        trajectory_features: bool = True,
        **kwargs: Any,
    ) -> None:
        self.task = Task.from_dict(task, ARMS)
        self.candidates = candidates
        self._compiled: dict[int, Any] = {}
        self._both: dict[str, Any] = {"width": width, "trajectory_features": trajectory_features}
        self._rounds: dict[str, Any] = {"rounds": rounds, "kept": kept, "heads": heads}
        super().__init__(observation_space, action_space, lr_schedule, **kwargs)

    def _build(self, lr_schedule: Any) -> None:
        """Actor and critic with their optimisers; nothing is bootstrapped, so each is its own target."""
        self.actor, self.critic = self.make_actor(), self.make_critic()
        for network in (self.actor, self.critic):
            network.optimizer = self.optimizer_class(
                network.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **self.optimizer_kwargs,
            )
        self.__dict__.update(actor_target=self.actor, critic_target=self.critic)  # not modules of their own

    def _get_constructor_parameters(self) -> dict[str, Any]:
        """What :meth:`save` keeps besides the weights."""
        ours = {"task": self.task.as_dict(), **self.settings, "candidates": self.candidates}
        return {**super()._get_constructor_parameters(), **ours}

    @property
    def settings(self) -> dict[str, Any]:
        """Of both networks."""
        return {**self._both, **self._rounds}

    def make_actor(self, features_extractor: Any = None) -> Any:
        """An actor for the task."""
        spaces_: Any = (self.observation_space, self.action_space)
        return ViaActor(*spaces_, task=self.task, **self.settings).to(self.device)

    def make_critic(self, features_extractor: Any = None) -> Any:
        """A critic for the task."""
        spaces_: Any = (self.observation_space, self.action_space)
        return ViaCritic(*spaces_, task=self.task, **self._both).to(self.device)

    def predict(self, observation: Any, state: Any = None, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """As its base class; in machine code where there is some.

        Raises:
            ValueError: The observation is not a dict with the parts of the observation space, is not finite, or the
                hand is in the goal already, to which there is no movement.
        """
        if isinstance(observation, tuple):  # of which the base class says more
            return super().predict(cast(Any, observation), state, *args, **kwargs)
        self._check_parts(observation)
        compiled = self._compiled.get(self.candidates)
        try:
            action = None if compiled is None else compiled(observation)
            return super().predict(observation, state, *args, **kwargs) if action is None else (action, state)
        except (RuntimeError, ValueError):
            _check_numbers(observation)  # only now: most decisions need not pay for it
            raise

    def _check_parts(self, observation: Any) -> None:
        space: Any = self.observation_space
        wanted = ", ".join(space.spaces)
        if not isinstance(observation, dict):
            raise ValueError(f"observation must be a dict of {wanted}; got {type(observation).__name__}")
        if observation.keys() != space.spaces.keys():
            raise ValueError(
                f"observation must have the parts {wanted}; got {', '.join(map(str, observation))}"
            )

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        return self.decide(observation, self.candidates)

    def decide(self, observation: Observation, candidates: int) -> Tensor:
        """The actor's own choice, or of so many candidates the critic's, shape (B, m)."""
        return self.ranked(observation, candidates) if candidates else cast(Tensor, self.actor(observation))

    def compile_decisions(self, candidates: int = 0, keep: str | Path | None = None) -> None:
        """Let machine code decide in single scenes from now on: the same decisions, ten times faster.

        That takes a minute or two and a C++ compiler, once in each process, or once at all where it is kept. It is
        for as many candidates as are said here; decisions with other numbers of them, in many scenes at once, and
        with weights that were changed afterwards are made as before. It is not saved with the model.

        Args:
            candidates: As :attr:`candidates` will be.
            keep: Folder in which the next process finds the machine code, if its agent, program and processor are the
                same. It is loaded as a program is: only from a folder that nobody else writes to.

        Raises:
            CannotCompileError: There is no compiler, or the task does not allow it.
            ValueError: What is kept cannot be loaded.
        """
        from viapoint.training.compiled import CompiledDecision

        self._compiled[candidates] = CompiledDecision(self, candidates, None if keep is None else Path(keep))

    def __getstate__(self) -> dict[str, Any]:
        """Copies are without machine code."""
        return {**self.__dict__, "_compiled": {}}

    def ranked(self, observation: Observation, candidates: int) -> Tensor:
        """The best of many movements in the critic's judgement, shape (B, m).

        Besides the anchors as many others are improved, spread evenly over the action space, so that a decision is
        deterministic; of the half that promises most, and of what a second improvement makes of it, the critic
        chooses.
        """
        actor, seen = self.actor, arrays(observation)
        view = actor.view(seen)
        scene = actor.encode_view(view)
        others = actor.look_at(seen, self._spread(candidates).expand(len(scene), -1, -1))
        every = Look(*(torch.cat(parts, dim=1) for parts in zip(actor.look(seen), others, strict=True)))
        look = actor.look_at(seen, best(actor.improve(scene, every), -(-candidates // 2)))
        further = actor.improve(scene, look).actions
        actions = torch.cat((look.actions, further), dim=1)
        if not self.critic.sighted:
            return most(actions, self.critic.judge(seen, actions).reward())
        foresight = self.critic.foresee(seen, further)
        features = torch.cat((look.vector(), foresight.vector()), dim=1)
        known = torch.cat((look.known, foresight.reward.total()), dim=1)
        return most(actions, self.critic.learned(view, features, actions) + known)

    def set_training_mode(self, mode: bool) -> None:
        """As its base class; where nothing changes, the modules are not gone through one by one."""
        if mode != self.training:
            super().set_training_mode(mode)

    def _spread(self, count: int) -> Tensor:
        """Actions spread evenly over the action space, shape (count, m)."""
        return spread_evenly(count, self.actor.size).to(self.actor.scene.weight.device)


@functools.cache
def spread_evenly(count: int, dimension: int) -> Tensor:
    """Points of a cube from -1 to 1, shape (count, dimension), always the same (Sobol')."""
    engine: Any = torch.quasirandom.SobolEngine
    sobol = engine(dimension, scramble=True, seed=1).draw(count)
    return cast(Tensor, 2.0 * sobol - 1.0)


def _check_numbers(observation: dict[str, Any]) -> None:
    """Say what of an observation no movement can begin with."""
    for name, part in observation.items():
        if not np.isfinite(np.asarray(part)).all():
            raise ValueError(f"observation must be finite; {name} is {np.asarray(part)}") from None
    apart = np.asarray(observation["goal"]) != np.asarray(observation["hand"])
    if not on_the_way(observation) and not apart.any(axis=-1).all():
        raise ValueError(
            "hand and goal must be apart: where they are the same there is no movement"
        ) from None
