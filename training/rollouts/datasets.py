"""Datasets of Minari: episodes of a method in an environment, which can be replayed."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.training.planning.baselines import Method, OpenLoopBaseline, PlannerMethod

DATASET_ID = re.compile(r"([-\w]+/)*[-\w]+-v\d+")  # As Minari allows: groups, name, version


def dataset_folder(dataset_id: str) -> Path:
    """Return the folder of a dataset, in MINARI_DATASETS_PATH or, by default, in ~/.minari/datasets."""
    if not DATASET_ID.fullmatch(dataset_id):
        raise ValueError(f"dataset must be named like group/name-v0, got {dataset_id!r}")
    root = os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets"
    return Path(root) / dataset_id


def record_dataset(
    dataset_id: str,
    env_id: str,
    env_kwargs: Mapping[str, Any],
    method: Method,
    episodes: int,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> Any:
    """Record episodes of a method as a Minari dataset, such as group/name-v0, and return it.

    Episode i is reset with `seed + i`. Its actions are those of the method in single precision, as the action space has
    them, so that a replay gives the same observations and rewards. `progress` is called with the method's name and the
    numbers of recorded and of all episodes.

    Raises:
        ValueError: The dataset exists, its name is not allowed, or decisions of the method are no actions.
        ImportError: Minari is not installed.
    """
    import minari

    folder = dataset_folder(dataset_id)
    if folder.exists():
        raise ValueError(f"dataset {dataset_id} exists in {folder}; name another one, or a new version")
    if isinstance(method, PlannerMethod | OpenLoopBaseline):
        raise ValueError(f"movements of {method.name} are no actions, which a dataset holds")
    env = gym.make(env_id, **env_kwargs)
    buffers = []
    for episode in range(episodes):
        buffers.append(_episode(env, method, episode, seed + episode))
        progress(method.name, episode + 1, episodes)
    with warnings.catch_warnings():  # an author, a web address and an evaluation environment may be missing
        warnings.simplefilter("ignore", UserWarning)
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            env=env,
            algorithm_name=method.name,
            description=f"{episodes} episodes of {method.name} in {env_id}, seeds {seed} to {seed + episodes - 1}",
        )
    env.close()
    return dataset


def _episode(env: gym.Env[Any, Any], method: Method, number: int, seed: int) -> Any:
    """Play one episode, and return it as a buffer of Minari.

    Minari's DataCollector would do so with JAX, which nothing else here needs.
    """
    from minari.data_collector import EpisodeBuffer

    unwrapped: Any = env.unwrapped
    observation, _ = env.reset(seed=seed)
    seen = [observation]
    steps: list[tuple[Any, ...]] = []
    over = False
    while not over:
        batch = {name: part[None] for name, part in observation.items()}
        decided = method.decide(batch, unwrapped.batch.scenes)[0]
        action = np.clip(decided, -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        seen.append(observation)
        steps.append((action, reward, terminated, truncated, info))
        over = terminated or truncated
    actions, rewards, terminations, truncations, infos = zip(*steps, strict=True)
    observations, reports = {}, {}
    for name in seen[0]:
        observations[name] = np.stack([each[name] for each in seen])
    for name in infos[0]:
        reports[name] = np.array([info[name] for info in infos])
    return EpisodeBuffer(
        id=number,
        seed=seed,
        observations=observations,
        actions=np.stack(actions),
        rewards=list(rewards),
        terminations=list(terminations),
        truncations=list(truncations),
        infos=reports,
    )
