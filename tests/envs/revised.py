"""Episodes whose plans are revised on the way: a few to begin with, and how to play them."""

import gymnasium as gym
import numpy as np

from viapoint.envs.sim.replan_triggers import Event

JUMP, MOVING, PANDA = (
    f"viapoint/{name}-v0" for name in ("PlanarTargetJump", "PlanarMovingObstacles", "PandaMovingObstacles")
)
START, GOAL, OTHER = np.array([-0.3, 0.4]), np.array([0.1, 0.4]), np.array([0.0, 0.55])
DT = 0.002
NO_ROWS = {"obstacles": np.zeros((0, 5))}


def make(env_id=JUMP, jumps=(), seed=0, obstacles=None, courses=None, **kwargs):
    """An environment in a given episode, and its first observation."""
    env = gym.make(env_id, **kwargs).unwrapped
    rows = NO_ROWS if obstacles is None else {"obstacles": np.array(obstacles), "courses": np.array(courses)}
    options = {"start": START, "goal": GOAL, "jumps": np.array(jumps).reshape(-1, 3), **rows}
    return env, env.reset(seed=seed, options=options)[0]


def play(env, actions=None, seed=0):
    """To the end, by zero or random actions: all infos."""
    generator, infos, over = np.random.default_rng(seed), [], False
    while not over:
        scale = 0.0 if actions is None else actions
        action = scale * generator.uniform(-1.0, 1.0, env.action_space.shape)
        _, reward, over, _, info = env.step(action.astype(np.float32))
        infos.append({**info, "reward": reward})
    return infos


def events(infos):
    return [Event(info["event"]) for info in infos]
