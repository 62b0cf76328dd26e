"""The minimum critic for Stable-Baselines3's own SAC and TD3.

    Q(s, a) = q0(ends, a) + min over obstacles i and heads h of q_h(obstacle i, ends, a)

A collision is a minimum over obstacles, which a critic on one pooled vector of the scene has to learn. Only the critic
differs: actor, replay buffer and updates are those of SAC and TD3.

Example:
    >>> import gymnasium as gym, viapoint.envs
    >>> from stable_baselines3 import SAC
    >>> from viapoint.training.algorithms.minimum_critic import MinimumCriticSACPolicy
    >>> model = SAC(MinimumCriticSACPolicy, gym.make("viapoint/PlanarObstacles-v0"), policy_kwargs={"heads": 2})
    >>> type(model.critic.qf0).__name__
    'MinimumQ'
"""

from __future__ import annotations

from typing import Any, cast

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.sac.policies import MultiInputPolicy as SACPolicy
from stable_baselines3.td3.policies import MultiInputPolicy as TD3Policy
from torch import Tensor, nn

from viapoint.training.algorithms.critic import dense
from viapoint.training.algorithms.extractors import SceneExtractor

ABSENT = 1e3
"""Value of an obstacle that is not there."""


class ObstacleRows(BaseFeaturesExtractor):
    """Scene as rows: ends, then every obstacle in the frame of start and goal, then which of them are present.

    Args:
        observation_space: Of an environment with obstacles.

    Raises:
        ValueError: There are no obstacles in the observation.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        if "obstacles" not in observation_space.spaces:
            raise ValueError(
                "a minimum critic needs an observation with the part obstacles, got one with "
                f"{', '.join(observation_space.spaces)}"
            )
        scene = SceneExtractor(observation_space, width=1)
        boxes = cast("dict[str, spaces.Box]", dict(observation_space.items()))
        self.row = 2 * scene.dimension + 1
        self.rows = boxes["obstacles"].shape[0] // (self.row + 1)
        self.ends = scene.features_dim - 2
        super().__init__(observation_space, self.ends + self.rows * (self.row + 1))
        self.scene = scene

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        """Return rows, shape (B, features_dim)."""
        ends, seen, present = self.scene.rows(observation)
        return torch.cat((ends, seen.flatten(1), present[..., 0]), dim=-1)


class MinimumQ(nn.Module):
    """Q network on :class:`ObstacleRows` and an action.

    Args:
        extractor: Layout of the features.
        size: Components of an action m.
        width: Of the hidden layers.
        heads: Networks of each obstacle, of which the minimum is taken.
    """

    def __init__(self, extractor: ObstacleRows, size: int, width: int, heads: int) -> None:
        super().__init__()
        self.layout = extractor.ends, extractor.rows, extractor.row
        self.pairs = dense(extractor.ends + extractor.row + size, width, width, heads)
        self.rest = dense(extractor.ends + size, width, width, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Return Q, shape (B, 1), of features and actions in one vector."""
        ends, rows, row = self.layout
        about, seen = features[:, :ends], features[:, ends : ends + rows * row].reshape(-1, rows, row)
        present = features[:, ends + rows * row : ends + rows * (row + 1)]
        plan = torch.cat((about, features[:, ends + rows * (row + 1) :]), dim=-1)
        pairs = torch.cat((seen, plan.unsqueeze(1).expand(-1, rows, -1)), dim=-1)
        values = self.pairs(pairs).amin(dim=-1)
        least = torch.where(present > 0.5, values, ABSENT).amin(dim=-1, keepdim=True)
        q: Tensor = self.rest(plan) + torch.where(least < ABSENT, least, 0.0)
        return q


class _MinimumCritic(BasePolicy):
    """Part of both policies: makes critics with a minimum over obstacles.

    Args:
        *args: Arguments of the policy of SAC or TD3.
        heads: Networks of each obstacle, of which the minimum is taken.
        critic_width: Of the hidden layers of the critics.
        **kwargs: As `args`; the actor sees the scene through :class:`SceneExtractor` if not told otherwise.
    """

    def __init__(self, *args: Any, heads: int = 1, critic_width: int = 128, **kwargs: Any) -> None:
        for name, value in (("heads", heads), ("critic_width", critic_width)):
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a whole number, 1 or more, got {value!r}")
        if kwargs.get("share_features_extractor"):
            raise ValueError("share_features_extractor must be False: a minimum critic sees rows of its own")
        self.heads, self.critic_width = heads, critic_width
        super().__init__(*args, **{"features_extractor_class": SceneExtractor, **kwargs})

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """Return a critic whose Q networks are minima over obstacles."""
        rows = ObstacleRows(cast(spaces.Dict, self.observation_space))
        self.critic_kwargs: dict[str, Any] = {**self.critic_kwargs, "net_arch": []}  # replaced below
        critic: ContinuousCritic = super().make_critic(rows)  # type: ignore[misc]
        size = get_action_dim(cast(spaces.Box, self.action_space))
        for i in range(critic.n_critics):
            network = MinimumQ(rows, size, self.critic_width, self.heads)
            critic.add_module(f"qf{i}", network)
            critic.q_networks[i] = network
        return critic.to(self.device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        ours = {"heads": self.heads, "critic_width": self.critic_width}
        return {**super()._get_constructor_parameters(), **ours}


class MinimumCriticSACPolicy(_MinimumCritic, SACPolicy):
    """Policy of SAC with a minimum critic; see :class:`_MinimumCritic` for its arguments."""


class MinimumCriticTD3Policy(_MinimumCritic, TD3Policy):
    """Policy of TD3 with a minimum critic; see :class:`_MinimumCritic` for its arguments."""


POLICIES: dict[str, type[BasePolicy]] = {"sac": MinimumCriticSACPolicy, "td3": MinimumCriticTD3Policy}
"""Policies by the name of their algorithm on the command line."""
