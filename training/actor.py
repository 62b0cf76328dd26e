"""The actor: from movements to better movements, and to what they are worth."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from torch import Tensor, nn

from viapoint.envs.task import Task
from viapoint.training.anchors import anchors_of
from viapoint.training.features import Look, fares_size, look_at, scene_sizes, scene_view
from viapoint.training.set_encoder import SetEncoder, layers
from viapoint.training.sight import Observation


class Improved(NamedTuple):
    """What the actor makes of A movements in each of B scenes."""

    actions: Tensor
    """Better ones, shape (B, A, m)."""
    promise: Tensor
    """Expected reward of the better ones, shape (B, A)."""
    worth: Tensor
    """Expected reward of the ones looked at but for the part that is known, shape (B, A)."""


class ViaActor(BaseModel):
    """Several ways round, each improved, and how promising each is.

    It is one operator: from a movement and how it would fare to a better movement and its worth. It begins at the
    anchors, so left and right of an obstacle, wide and narrow are there from the start and no gradient need cross an
    obstacle; then it sees how the most promising of its own proposals would fare, and improves them again.
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        *,
        task: Task,
        width: int,
        rounds: int,
        kept: int,
        heads: int | None = None,
        trajectory_features: bool = True,
    ) -> None:
        super().__init__(observation_space, action_space)
        self.task, self.anchors = task, anchors_of(task, observation_space.spaces, heads)
        self.rounds, self.kept, self.sighted = rounds, kept, trajectory_features
        self.encoder = SetEncoder(*scene_sizes(observation_space.spaces, task), width // 4)
        self.size = get_action_dim(action_space)
        self.scene = nn.Linear(self.encoder.size, width)
        self.movement = nn.Linear(fares_size(task) + self.size, width, bias=False)
        self.hidden = nn.Sequential(nn.ReLU(), layers(width, width))
        self.step = nn.Linear(width, self.size)
        self.value = nn.Linear(width, 2)
        nn.init.zeros_(self.step.weight)
        nn.init.zeros_(self.step.bias)

    def look(self, observation: Observation) -> Look:
        """What the actor sees of its anchors."""
        return self._tensors(self.anchors.look(arrays(observation)))

    def look_at(self, observation: Observation, actions: Tensor) -> Look:
        """What it sees of actions of its own, shape (B, A, m)."""
        inside = actions.detach().clamp(-0.999, 0.999).cpu().numpy()
        return self._tensors(look_at(arrays(observation), inside, self.task))

    def encode(self, observation: Observation) -> Tensor:
        """The scene as the operator takes it, shape (B, width)."""
        return cast(Tensor, self.scene(self.encoder(scene_view(observation, self.task))))

    def improve(self, scene: Tensor, look: Look) -> Improved:
        """Better movements, and what the ones looked at promise and are worth."""
        seen = self.movement(torch.cat((look.fares, look.actions), dim=-1))
        hidden = self.hidden(scene.unsqueeze(1) + seen)
        promise, worth = self.value(hidden).unbind(dim=-1)
        return Improved(torch.tanh(torch.atanh(look.actions) + self.step(hidden)), promise, worth)

    def propose(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """The movements of the last round, shape (B, kept, m), and their worth, shape (B, kept)."""
        scene, look = self.encode(observation), self.look(observation)
        for _ in range(self.rounds):
            look = self.look_at(observation, best(self.improve(scene, look), self.kept))
        return look.actions, self.improve(scene, look).worth + look.known

    def _tensors(self, look: Look) -> Look:
        look = Look(*(torch.as_tensor(part, dtype=torch.float32, device=self.device) for part in look))
        return look if self.sighted else look._replace(fares=torch.zeros_like(look.fares))

    def forward(self, observation: Observation) -> Tensor:
        """The most worthy action, shape (B, m)."""
        actions, worth = self.propose(observation)
        return actions[torch.arange(len(actions)), worth.argmax(dim=-1)]

    def _predict(self, observation: Observation, deterministic: bool = False) -> Tensor:
        return cast(Tensor, self(observation))


def best(improved: Improved, count: int) -> Tensor:
    """The better movements that promise most, shape (B, count, m)."""
    rows = torch.arange(len(improved.promise)).unsqueeze(-1)
    chosen = improved.promise.topk(min(count, improved.promise.shape[1]), dim=-1).indices
    return improved.actions[rows, chosen]


def arrays(observation: Observation) -> Observation:
    """Looking is done in NumPy: there are no gradients, and small arrays are dealt with faster."""
    return {name: part.detach().cpu().numpy() for name, part in observation.items()}
