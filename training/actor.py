"""The actor: from movements to better movements, and to what they are worth."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from torch import Tensor, nn

from viapoint.envs.task import Task
from viapoint.training import graphs
from viapoint.training.anchors import anchors_of
from viapoint.training.features import Look, SceneView, fares_size, look_at, scene_sizes, scene_view
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
        return self._seen(self.anchors.look(arrays(observation)))

    def look_at(self, observation: Observation, actions: Tensor) -> Look:
        """What it sees of actions of its own, shape (B, A, m)."""
        inside = arrays({"": actions.detach().clamp(-0.999, 0.999)})[""]
        return self._seen(look_at(arrays(observation), inside, self.task))

    def encode(self, observation: Observation) -> Tensor:
        """The scene as the operator takes it, shape (B, width)."""
        return self.encode_view(self.view(observation))

    def view(self, observation: Observation) -> SceneView:
        """The scene as networks see it."""
        return SceneView(*tensors(scene_view(arrays(observation), self.task), self.scene.weight))

    def encode_view(self, view: SceneView) -> Tensor:
        """The same of a scene that is seen already."""
        return cast(Tensor, self.scene(self.encoder(view)))

    def improve(self, scene: Tensor, look: Look) -> Improved:
        """Better movements, and what the ones looked at promise and are worth."""
        seen = self.movement(torch.cat((look.fares, look.actions), dim=-1))
        hidden = self.hidden(scene.unsqueeze(1) + seen)
        promise, worth = self.value(hidden).unbind(dim=-1)
        return Improved(torch.tanh(torch.atanh(look.actions) + self.step(hidden)), promise, worth)

    def propose(self, observation: Observation) -> tuple[Tensor, Tensor]:
        """The movements of the last round, shape (B, kept, m), and their worth, shape (B, kept)."""
        seen = arrays(observation)
        scene, look = self.encode(seen), self.look(seen)
        for _ in range(self.rounds):
            look = self.look_at(seen, best(self.improve(scene, look), self.kept))
        return look.actions, self.improve(scene, look).worth + look.known

    def _seen(self, look: Look) -> Look:
        look = Look(*tensors(look, self.scene.weight))
        return look if self.sighted else look._replace(fares=torch.zeros_like(look.fares))

    def forward(self, observation: Observation) -> Tensor:
        """The most worthy action, shape (B, m)."""
        return most(*self.propose(observation))

    def _predict(self, observation: Observation, deterministic: bool = False) -> Tensor:
        return cast(Tensor, self(observation))


def best(improved: Improved, count: int) -> Tensor:
    """The better movements that promise most, shape (B, count, m)."""
    chosen = improved.promise.topk(min(count, improved.promise.shape[1]), dim=-1).indices
    return _at(improved.actions, chosen)


def most(actions: Tensor, worth: Tensor) -> Tensor:
    """The action that is worth most in each scene, shape (B, m), of actions (B, A, m) and their worth (B, A)."""
    return _at(actions, worth.argmax(dim=-1, keepdim=True))[:, 0]


def _at(actions: Tensor, chosen: Tensor) -> Tensor:
    return actions.gather(1, chosen.unsqueeze(-1).expand(-1, -1, actions.shape[-1]))


def arrays(observation: Observation) -> Observation:
    """Looking is done in NumPy, but for graphs: there are no gradients, and small arrays are dealt with faster."""
    if graphs.is_drawn():
        return observation
    return {
        name: part if type(part) is np.ndarray else part.detach().cpu().numpy()
        for name, part in observation.items()
    }


def tensors(parts: Iterable[Any], like: Tensor) -> Iterator[Tensor]:
    """What was seen as tensors where `like` is, numbers in its precision."""
    for part in parts:
        tensor = torch.as_tensor(part)
        kind = like.dtype if tensor.is_floating_point() else tensor.dtype
        yield tensor if tensor.dtype is kind and like.is_cpu else tensor.to(device=like.device, dtype=kind)
