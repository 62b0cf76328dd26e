"""Policies that give SAC and TD3 of Stable-Baselines3 a critic with a minimum over obstacles.

    Q(s, a) = q0(ends, a) + min over obstacles i and heads h of q_h(obstacle i, ends, a)

The clearance of a plan is a minimum over obstacles. A critic on one pooled vector of the scene has to learn this
structure; this critic has it. Actor, replay buffer and updates are those of SAC and TD3.

Example:
    >>> import gymnasium as gym, viapoint.envs
    >>> from stable_baselines3 import SAC
    >>> from viapoint.training.algorithms.sb3_minimum_critic import MinimumCriticSACPolicy
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

from viapoint.envs.common.validation import whole_number
from viapoint.training.algorithms.extractors import SceneExtractor
from viapoint.training.algorithms.pair_networks import dense

ABSENT = 1e3
"""Value of a row without an obstacle."""


class ObstacleRows(BaseFeaturesExtractor):
    """Features that keep each obstacle apart: ends, obstacle rows in the frame of start and goal, presence.

    Args:
        observation_space: Observation space of an environment with obstacles.

    Raises:
        ValueError: The observation has no part `obstacles`.
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        if "obstacles" not in observation_space.spaces:
            raise ValueError(
                "a minimum critic needs an observation with the part obstacles; got the parts "
                f"{', '.join(observation_space.spaces)}"
            )
        scene = SceneExtractor(observation_space, width=1)
        self.row, self.rows = scene.row_size - 1, scene.n_rows
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
        extractor: Extractor that defines the layout of the features.
        size: Number of components of an action.
        width: Width of the hidden layers.
        heads: Number of outputs for each obstacle, of which the minimum is taken.
    """

    def __init__(self, extractor: ObstacleRows, size: int, width: int, heads: int) -> None:
        super().__init__()
        self.layout = extractor.ends, extractor.rows, extractor.row
        self.pairs = dense(extractor.ends + extractor.row + size, width, width, heads)
        self.rest = dense(extractor.ends + size, width, width, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Return Q, shape (B, 1), for concatenated features and actions."""
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
    """Mixin that makes critics with a minimum over obstacles.

    Args:
        *args: Arguments of the policy of SAC or TD3.
        heads: Number of outputs for each obstacle, of which the minimum is taken.
        critic_width: Width of the hidden layers of the critics.
        **kwargs: Keyword arguments of the policy; `features_extractor_class` of the actor defaults to
            :class:`SceneExtractor`.
    """

    def __init__(self, *args: Any, heads: int = 1, critic_width: int = 128, **kwargs: Any) -> None:
        heads, critic_width = whole_number("heads", heads, 1), whole_number("critic_width", critic_width, 1)
        if kwargs.get("share_features_extractor"):
            raise ValueError(
                "share_features_extractor must be False: a minimum critic has its own features extractor"
            )
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
    """Policy of SAC with a minimum critic; further arguments are `heads` and `critic_width`."""


class MinimumCriticTD3Policy(_MinimumCritic, TD3Policy):
    """Policy of TD3 with a minimum critic; further arguments are `heads` and `critic_width`."""


POLICIES: dict[str, type[BasePolicy]] = {"sac": MinimumCriticSACPolicy, "td3": MinimumCriticTD3Policy}
"""Policy class by the command-line name of the algorithm."""
