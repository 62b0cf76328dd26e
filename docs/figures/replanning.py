"""The animation of plans that are revised, for the documentation: `python docs/figures/replanning.py`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
from PIL import Image
from rendered import PAUSE, SPEED

from viapoint.training import Agent, load_agent
from viapoint.training.planners.baselines import agent_method
from viapoint.training.scene_sets.scene_set import load

SHOWN = {"viapoint/PlanarMovingObstacles-v0": (2, 45), "viapoint/PlanarTargetJump-v0": (3,)}
"""Validation scenes in which the shipped agents are shown."""


def frames(agent: Agent, rows: tuple[int, ...], size: int) -> list[list[Any]]:
    """Pictures of an agent's episodes in validation scenes."""
    env: Any = gym.make(
        agent.env_id, render_mode="rgb_array_list", width=size, height=size, **agent.env_kwargs
    )
    decide, scenes = agent_method("agent", agent, 0).decide, load("validation", agent.env_id).scenes
    episodes = []
    for row in rows:
        scene, over = scenes.take([row]), False
        observation, _ = env.reset(options=scene.as_options())
        while not over:
            action = decide({name: part[None] for name, part in observation.items()}, scene)[0]
            observation, _, over, _, _ = env.step(action.astype("float32"))
        episodes.append(list(env.render()))
    env.close()
    return episodes


def animation(path: Path, *, size: int = 320) -> None:
    """The episodes one after the other, for ever."""
    images, durations = [], []
    for env_id, rows in SHOWN.items():
        agent = load_agent(env_id)
        env = gym.make(env_id)
        each = round(1000.0 / (env.metadata["render_fps"] * SPEED))
        env.close()
        for episode in frames(agent, rows, size):
            images += [Image.fromarray(frame) for frame in episode]
            durations += [each] * (len(episode) - 1) + [PAUSE]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=durations, loop=0, quality=75, method=4
    )


def main() -> None:
    """Make it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder to write to")
    path: Path = parser.parse_args().out / "revising.webp"
    animation(path)
    print(f"{path}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
