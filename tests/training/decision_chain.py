"""An environment whose decisions last differently long."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SECONDS = np.array([0.1, 0.6, 0.25, 0.4])
"""Of the decisions of the chain."""
PAID = np.array([0.5, 0.0, -0.2, 1.0])
BOX = spaces.Box(-1.0, 1.0, (3,), np.float32)
ACTION = spaces.Box(-1.0, 1.0, (1,), np.float32)


class Chain(gym.Env):
    """Four decisions, of different length whatever is decided; observes which is next."""

    observation_space = spaces.Box(0.0, 1.0, (len(PAID),), np.float32)
    action_space = ACTION

    def __init__(self, key="elapsed", cut=None):
        self.key, self.cut = key, cut

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = 0
        return self._observed(), {}

    def step(self, action):
        here, self.place = self.place, self.place + 1
        info = {self.key: SECONDS[here]} if self.key else {}
        return self._observed(), PAID[here], self.place == len(PAID), self.place == self.cut, info

    def _observed(self):
        return np.eye(len(PAID), dtype=np.float32)[min(self.place, len(PAID) - 1)]
