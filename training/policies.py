"""Networks for a set of obstacles: an actor that knows several ways round, a critic that foresees the movement."""

from __future__ import annotations

import itertools
from typing import Any, cast

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.td3.policies import TD3Policy
from torch import Tensor, nn

from viapoint.envs.arms import ARMS
from viapoint.envs.task import Task
from viapoint.training.features import (
    GEOMETRY,
    PHASES,
    Anchors,
    Look,
    Observation,
    SceneView,
    foresee,
    scene_view,
)


def _layers(*sizes: int) -> nn.Sequential:
    """Linear layers with rectifiers between them, and after them where there are two or more (He et al. 2015)."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes):
        linear = nn.Linear(fan_in, fan_out)
        nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers)


class SetEncoder(nn.Module):
    """A scene as a vector, whatever the number and order of its obstacles.

    Each obstacle passes through the same network; sum and maximum over those present follow (Zaheer et al. 2017, Deep
    Sets, arXiv 1703.06114).
    """

    def __init__(self, dimension: int, width: int) -> None:
        super().__init__()
        self.each = _layers(4 * dimension + 2, width, width)
        self.size = 2 * width + 2 * dimension + 1

    def forward(self, scene: SceneView) -> Tensor:
        """Shape (B, size)."""
        rows = scene.rows.shape[1]
        ends = scene.ends.unsqueeze(1).expand(-1, rows, -1)
        encoded = self.each(torch.cat((scene.rows, ends), dim=-1)) * scene.present.unsqueeze(-1)
        return torch.cat((0.5 * encoded.sum(dim=1), encoded.amax(dim=1), scene.ends), dim=-1)


class ViaActor(BaseModel):
    """Several ways round, each improved, and how promising each is.

    A head begins at an anchor, a fixed movement, and sees how that would fare. All heads share one network. So left
    and right of an obstacle, wide and narrow are there from the start, and no gradient need cross an obstacle.
    """

    def __init__(
        self, observation_space: spaces.Dict, action_space: spaces.Box, *, task: Task, width: int
    ) -> None:
        super().__init__(observation_space, action_space)
        self.task, self.anchors = task, Anchors(task)
        self.encoder = SetEncoder(task.arm.dimension, width // 4)
        self.size = get_action_dim(action_space)
        seen = self.encoder.size + GEOMETRY + PHASES * task.arm.dimension + self.size
        self.each = _layers(seen, width, width)
        self.improve = nn.Linear(width, self.size)
        self.score = nn.Linear(width, 1)
        nn.init.zeros_(self.improve.weight)
        nn.init.zeros_(self.improve.bias)

    def look(self, observation: Observation) -> Look:
        """What the actor sees, all of it fixed functions of the observation."""
        with torch.no_grad():
            return self.anchors.look(observation)

    def propose(self, look: Look) -> tuple[Tensor, Tensor]:
        """Actions, shape (B, A, m), and the expected reward of each, shape (B, A)."""
        scene = self.encoder(look.scene).unsqueeze(1).expand(-1, look.anchors.shape[1], -1)
        hidden = self.each(torch.cat((scene, look.fares, look.anchors), dim=-1))
        return torch.tanh(torch.atanh(look.anchors) + self.improve(hidden)), self.score(hidden).squeeze(-1)

    def forward(self, observation: Observation) -> Tensor:
        """The most promising action, shape (B, m)."""
        actions, scores = self.propose(self.look(observation))
        return actions[torch.arange(len(actions)), scores.argmax(dim=-1)]

    def _predict(self, observation: Observation, deterministic: bool = False) -> Tensor:
        return cast(Tensor, self(observation))


class ViaCritic(BaseModel):
    """What the physics will make of an action: the part of the reward that no formula gives.

    It sees action, scene and the features of the planned movement.
    """

    def __init__(
        self, observation_space: spaces.Dict, action_space: spaces.Box, *, task: Task, width: int
    ) -> None:
        super().__init__(observation_space, action_space)
        self.task = task
        self.encoder = SetEncoder(task.arm.dimension, width // 4)
        size = self.encoder.size + get_action_dim(action_space) + GEOMETRY + 1
        self.value = nn.Sequential(_layers(size, width, width), nn.Linear(width, 1))

    def judge(self, observation: Observation, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Learned and known part of the reward of H actions in each of B scenes, shape (B, H) each."""
        foresight = foresee(observation, actions, self.task)
        scene = self.encoder(scene_view(observation, self.task))
        scene = scene.unsqueeze(1).expand(-1, actions.shape[1], -1)
        learned = self.value(torch.cat((scene, actions, foresight.vector()), dim=-1)).squeeze(-1)
        return learned, foresight.known_reward

    def forward(self, observation: Observation, actions: Tensor) -> tuple[Tensor]:
        """The expected reward of one action in each scene, shape (B, 1), as SB3's critics return it."""
        learned, known = self.judge(observation, actions.unsqueeze(1))
        return (learned + known,)


class ViaPolicy(TD3Policy):
    """Actor and critic of :class:`~viapoint.training.via_td3.ViaTD3`.

    Args:
        observation_space: Of the environment.
        action_space: Of the environment.
        lr_schedule: Learning rate against the progress that remains.
        task: The environment's task as plain values, see :meth:`viapoint.envs.task.Task.as_dict`.
        width: Of the hidden layers.
        candidates: How many random neighbours of the proposals the critic ranks, besides the proposals themselves, at
            each decision; 0 takes the actor's own choice.
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
        width: int = 192,
        candidates: int = 0,
        **kwargs: Any,
    ) -> None:
        self.task = Task.from_dict(task, ARMS)
        self.width, self.candidates = width, candidates
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

    def make_actor(self, features_extractor: Any = None) -> Any:
        """An actor for the task."""
        spaces_: Any = (self.observation_space, self.action_space)
        return ViaActor(*spaces_, task=self.task, width=self.width).to(self.device)

    def make_critic(self, features_extractor: Any = None) -> Any:
        """A critic for the task."""
        spaces_: Any = (self.observation_space, self.action_space)
        return ViaCritic(*spaces_, task=self.task, width=self.width).to(self.device)

    def _predict(self, observation: Any, deterministic: bool = False) -> Tensor:
        if not self.candidates:
            return cast(Tensor, self.actor(observation))
        return self.ranked(observation, self.candidates)

    def ranked(self, observation: Observation, candidates: int) -> Tensor:
        """The best of the proposals and their neighbours in the critic's judgement, shape (B, m).

        Neighbours lie on fixed offsets about the most promising proposals, so that a decision is deterministic.
        """
        proposals, scores = self.actor.propose(self.actor.look(observation))
        rows = torch.arange(len(proposals)).unsqueeze(-1)
        promising = proposals[rows, scores.topk(4, dim=-1).indices]
        offsets = self._offsets(-(-candidates // promising.shape[1]))
        near = (promising.unsqueeze(2) + offsets).flatten(1, 2).clamp(-1.0, 1.0)
        actions = torch.cat((proposals, near), dim=1)
        learned, known = self.critic.judge(observation, actions)
        return actions[rows[:, 0], (learned + known).argmax(dim=-1)]

    def _offsets(self, count: int) -> Tensor:
        engine: Any = torch.quasirandom.SobolEngine
        sobol = engine(self.actor.size, scramble=True, seed=1).draw(count)
        return cast(Tensor, 0.5 * (2.0 * sobol - 1.0) ** 3)  # denser near the proposal
