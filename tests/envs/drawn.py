"""What is drawn where drawing is tested."""

import numpy as np

OBSTACLES = "viapoint.envs:viapoint/PlanarObstacles-v0"
SCENE = {
    "start": [-0.1, 0.25],
    "goal": [-0.1, 0.55],
    "obstacles": [[-0.4, 0.6, 0.0, 0.0, 0.02], [-0.2, 0.4, 0.09, 0.0, 0.01]],
}
STRAIGHT = np.zeros(3, dtype=np.float32)
AROUND = np.array([0.0, -0.5, 0.5], dtype=np.float32)


def moved(env, action):
    env.reset(options={name: np.array(value) for name, value in SCENE.items()})
    return env.step(action)[-1]
