"""Scenes that the buttons of the live page draw: random ones, and the next ones of the shipped sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym

from viapoint.envs.scenes.scene import rows_of_lights
from viapoint.training.live.scene_file import LiveScene
from viapoint.training.scene_sets.scene_set import frozen_fit, load

Draw = Callable[[], LiveScene]
"""Function that returns the next scene of a kind."""


def scene_kinds(
    env_id: str, env_kwargs: Mapping[str, Any], task: Any, seed: int | None = None
) -> dict[str, Draw]:
    """Return functions that draw scenes, by the names of their buttons.

    Args:
        env_id: Environment whose actions are whole movements or revisions of them.
        env_kwargs: Arguments of the environment.
        task: Its task.
        seed: Seed of the random scenes.
    """
    kinds: dict[str, Draw] = {"Random": _random(env_id, env_kwargs, seed)}
    for label, name in (("Test", "test"), ("Hard", "hard")):
        if frozen_fit(name, env_id, env_kwargs):
            kinds[label] = _next_of(name, env_id)
    if not (task.spatial or task.whole_arm or task.replanning) and task.observation.n_rows:
        kinds["Lights 1985"] = _lights()
    return kinds


def _random(env_id: str, env_kwargs: Mapping[str, Any], seed: int | None) -> Draw:
    env: Any = gym.make_vec(env_id, num_envs=1, threads=1, **env_kwargs)
    seeds = [seed]

    def draw() -> LiveScene:
        env.reset(seed=seeds.pop() if seeds else None)
        return LiveScene.of(env.unwrapped.scenes)

    return draw


def _next_of(name: str, env_id: str) -> Draw:
    """Return a function that draws the scenes of a shipped set one after the other."""
    state: dict[str, Any] = {"next": 0}

    def draw() -> LiveScene:
        if "scenes" not in state:
            state["scenes"] = load(name, env_id).scenes
        scenes = state["scenes"]
        row = state["next"] % len(scenes.start)
        state["next"] = row + 1
        return LiveScene.of(scenes, row)

    return draw


def _lights() -> Draw:
    """Return a function that draws the obstacle paradigm of Flash & Hogan 1985, pair by pair."""
    state = {"next": 0}

    def draw() -> LiveScene:
        pairs, scenes = rows_of_lights()
        row = state["next"] % len(pairs)
        state["next"] = row + 1
        return LiveScene.of(scenes, row)

    return draw
