"""Datasets of Minari: episodes of a method in an environment, which can be replayed."""

from __future__ import annotations

import re
import shutil
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from viapoint.training.planning.baselines import Method, PlannerMethod

# Groups, name and version, as Minari allows them; it does not always ask for a version
DATASET_ID = re.compile(r"([-\w]{2,}/)*[-\w]+-v\d+")
GROUP_FILE = "namespace_metadata.json"  # File of Minari in the folder of a group


def dataset_folder(dataset_id: str) -> Path:
    """Return the folder of a dataset, in MINARI_DATASETS_PATH or, by default, in ~/.minari/datasets."""
    from minari.storage import get_dataset_path

    if not DATASET_ID.fullmatch(dataset_id):
        allowed = "letters, digits, - and _, two or more in a group"
        raise ValueError(f"dataset must be named like group/name-v0, of {allowed}, got {dataset_id!r}")
    return Path(get_dataset_path(dataset_id))


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

    Episode i is reset with `seed + i`. Actions are in single precision, as the action space has them, so that a replay
    gives the same. `progress` is called with the method's name and the numbers of recorded and of all episodes.

    Raises:
        ValueError: The dataset exists, its name is not allowed, or decisions of the method are no actions.
        ImportError: Minari is not installed.
    """
    import minari

    if isinstance(method, PlannerMethod):
        raise ValueError(f"movements of {method.name} are no actions; those of an agent or search512 are")
    folder = dataset_folder(dataset_id)
    if folder.exists():
        raise ValueError(f"dataset {dataset_id} exists in {folder}; name another one, or a new version")
    with closing(gym.make(env_id, **env_kwargs)) as env:
        buffers = []
        for episode in range(episodes):
            buffers.append(_episode(env, method, episode, seed + episode))
            progress(method.name, episode + 1, episodes)
        with warnings.catch_warnings(), _whole_or_nothing(folder):
            # An author, a web address and an evaluation environment may be missing.
            warnings.simplefilter("ignore", UserWarning)
            told = f"{episodes} episodes of {method.name} in {env_id}, seeds {seed} to {seed + episodes - 1}"
            about: Any = {"algorithm_name": method.name, "description": told}
            return minari.create_dataset_from_buffers(dataset_id, buffers, env=env, **about)


@contextmanager
def _whole_or_nothing(folder: Path) -> Iterator[None]:
    """Remove a new dataset that was not finished, and the groups that were made for it alone."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        yield
    except BaseException:
        for each in made:
            if each == folder:
                shutil.rmtree(folder, ignore_errors=True)
            elif each.exists() and {path.name for path in each.iterdir()} <= {GROUP_FILE}:
                shutil.rmtree(each, ignore_errors=True)
        raise


def _episode(env: gym.Env[Any, Any], method: Method, number: int, seed: int) -> Any:
    """Play one episode, and return it as a buffer of Minari.

    Minari's DataCollector would do so with JAX, which nothing else here needs.
    """
    from minari.data_collector import EpisodeBuffer

    unwrapped: Any = env.unwrapped
    observation, _ = env.reset(seed=seed)
    seen = [observation]
    infos: list[dict[str, Any]] = []
    names = ("actions", "rewards", "terminations", "truncations")
    played: dict[str, list[Any]] = defaultdict(list)
    over = False
    while not over:
        batch = {name: part[None] for name, part in observation.items()}
        decided = method.decide(batch, unwrapped.batch.scenes)[0]
        action = np.clip(decided, -1.0, 1.0).astype(np.float32)
        observation, *result, info = env.step(action)
        seen.append(observation)
        infos.append(info)
        for name, value in zip(names, (action, *result), strict=True):
            played[name].append(value)
        over = any(result[1:])
    observations = {name: np.stack([each[name] for each in seen]) for name in observation}
    reports = {name: np.array([each[name] for each in infos]) for name in infos[0]}
    actions = np.stack(played.pop("actions"))
    told = {"id": number, "seed": seed, "observations": observations, "actions": actions, "infos": reports}
    return EpisodeBuffer(**told, **played)
