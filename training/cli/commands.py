"""Commands `train`, `evaluate`, `play` and `record`."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
import warnings
from collections import defaultdict
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, TextIO

import gymnasium as gym
import numpy as np
import pandas as pd

from viapoint.envs.arms.registry import arm_of
from viapoint.training import configs, report
from viapoint.training import trainer as training
from viapoint.training.agents.agent import Agent, best_model, load_agent
from viapoint.training.agents.model_io import check_same_task
from viapoint.training.checks import SHIPPED_IDS
from viapoint.training.configs import AgentConfig, EvaluateConfig, PlayConfig, RecordConfig, TrainConfig
from viapoint.training.evaluation import evaluate as measure
from viapoint.training.files import BadFileError, read_json, versions, write_json
from viapoint.training.planning import benchmark
from viapoint.training.planning.baselines import PLANNERS, Method, agent_method, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.report import scene_progress
from viapoint.training.rollout import whole_task
from viapoint.training.scene_sets import evenly_spread, scenes_for

MOST_FAULTS = 10  # Greatest number of problems that are named with what is wrong
# Groups, name and version of a dataset, as Minari allows them; it does not always ask for a version
DATASET_ID = re.compile(r"([-\w]{2,}/)*[-\w]+-v\d+")


def train(config: TrainConfig) -> None:
    """Train, and print the run."""
    print(training.train(config))


def _named(config: AgentConfig, name: str | None) -> tuple[Agent | None, str, dict[str, Any]]:
    """Return the agent of a name, if any, and the id and the arguments of the environment of a configuration."""
    agent = None if name is None else load_agent(name)
    if agent is not None and config.env not in (None, agent.env_id):
        raise ValueError(f"env must be {agent.env_id}, on which the agent was trained, got {config.env!r}")
    env_id, argument = configs.env_of_arm(config.arm, config.env if agent is None else agent.env_id)
    if env_id is None:
        raise ValueError("name an agent (first, or as --agent NAME), or an environment: --env or --arm")
    env_kwargs = {**({} if agent is None else agent.env_kwargs), **argument, **config.env_kwargs}
    task = configs.task_with(env_id, env_kwargs)  # says what is wrong with an argument
    if agent is not None:
        check_same_task(configs.task_with(agent.env_id, agent.env_kwargs), task)
    return agent, env_id, env_kwargs


def evaluate(config: EvaluateConfig) -> None:
    """Evaluate, print the table, and write the results."""
    if config.of_planners:
        _measure_planners(config)
        return
    agent, env, env_kwargs = _named(config, config.agent)
    names = ("scenes", "n_scenes", "checks", "refine", "baselines")
    settings = {name: getattr(config, name) for name in names}
    with scene_progress() as progress:
        result = measure(agent, env=env, env_kwargs=env_kwargs, progress=progress, **settings)
    record = result.to_dict()
    print(report.formatted(record, config.format))
    folder = Path(config.agent or "").expanduser()
    # Also of a run whose id is not registered here.
    if config.agent is not None and (folder / "config.json").is_file():
        record["weights_sha256"] = read_json(best_model(folder) / "model.json").get("weights_sha256")
        name = f"{Path(config.scenes).stem}-{result.sha256[:8]}"  # the hash is that of the scenes
        if config.env_kwargs:
            record["env_kwargs"] = config.env_kwargs
            changed = json.dumps(config.env_kwargs, sort_keys=True).encode()
            name += f"-{hashlib.sha256(changed).hexdigest()[:8]}"
        if result.partial:
            name += ".partial"
        kept = folder / "evaluations" / f"{name}.json"
        write_json(kept, _with_earlier(record, kept))
        print(f"kept as {kept}", file=_notes(config))
    if config.json is not None:
        write_json(config.json, record)
        print(f"results, scene by scene: {config.json}", file=_notes(config))
    if result.partial:
        print("the results are partial", file=_notes(config))
        raise KeyboardInterrupt  # after all that is there has been written


def _with_earlier(record: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a record with the methods of an earlier one of the same weights in the same scenes, if there is one."""
    try:
        earlier = read_json(path)
        if earlier["weights_sha256"] != record["weights_sha256"]:
            return record
        added = {part: {**earlier[part], **record[part]} for part in ("methods", "outcomes")}
    except (BadFileError, KeyError, TypeError):  # there is none, or it is damaged
        return record
    return {**record, **added}


def _notes(config: EvaluateConfig) -> TextIO:
    """Return where to print what is not part of the table: elsewhere if a program reads it."""
    return sys.stderr if config.format in ("csv", "json") else sys.stdout


def _measure_planners(config: EvaluateConfig) -> None:
    """Measure planners on the problems of MotionBenchMaker, print the table, and write one line for each problem."""
    arm = benchmark.benchmark_panda() if config.arm is None else arm_of(config.arm)
    problems = benchmark.benchmark_problems()
    faults = list[str]()
    if config.problems is not None:
        joints = benchmark.JOINTS if config.arm is None else arm.joint_names
        problems, faults = benchmark.read_problems(config.problems, joints)
    problems = [problems[row] for row in evenly_spread(len(problems), config.n_scenes)]
    names = ("plan_motion",) if config.baselines == configs.USUAL_BASELINES else config.baselines
    for name in names:
        benchmark.benchmark_planner(name)  # an unknown name is told before anything is measured
    with scene_progress() as progress:
        lines = [benchmark.measure_planner(name, problems, arm, progress=progress) for name in names]
    table = pd.concat(lines)
    refused = table[table.refused != ""].drop_duplicates(["set", "number"])
    faults += [f"{each.set} {each.number}: {each.refused}" for each in refused.itertuples()]
    if faults:
        print(f"problems left out: {len(faults)}", *faults[:MOST_FAULTS], sep="\n  ", file=sys.stderr)
    if (table.refused != "").all():
        raise ValueError("no problem is left to measure planners on")
    if config.format == "csv":
        print(table.to_csv(index=False).rstrip())
    elif config.format == "json":
        print(table.to_json(orient="records", indent=1))
    else:
        print(f"{benchmark.markdown(table)}\n\n{benchmark.NOTES}")
    if config.json is not None:
        write_json(config.json, {"viapoint": versions()["viapoint"], "problems": table.to_dict("records")})
        print(f"results, problem by problem: {config.json}", file=_notes(config))


def play(config: PlayConfig) -> None:
    """Record a video of the movements of an agent, or of the geometry search."""
    from viapoint.training.video import record_video

    agent, env_id, env_kwargs = _named(config, config.agent)
    scenes = scenes_for(config.scenes, registered_task(env_id, **env_kwargs), config.n_scenes).scenes
    if agent is None:
        env_kwargs = whole_task(env_id, env_kwargs)
        method = make_method("search512", env_id, **env_kwargs)
    else:
        method = agent_method("agent", agent, config.checks)
    with closing(gym.make(env_id, render_mode="rgb_array_list", **env_kwargs)) as env:
        record_video(config.video, env, scenes, method.decide, name=method.name)
    print(f"{len(scenes.start)} movements: {config.video}")


def record(config: RecordConfig) -> None:
    """Record episodes of an agent or a baseline as a Minari dataset, and print how to load it."""
    name = str(config.agent)
    folder = Path(name).expanduser()
    if name in SHIPPED_IDS or any((folder / each).is_file() for each in ("model.json", "config.json")):
        if config.env_kwargs:
            raise ValueError("env_kwargs are for baselines; an agent has those of its training")
        agent, env_id, env_kwargs = _named(config, name)
        method = agent_method("agent", agent)
    else:
        if config.env is config.arm is None:
            raise ValueError(f"there is no agent {name!r}; a baseline needs an environment: --env or --arm")
        _, env_id, env_kwargs = _named(config, None)
        if registered_task(env_id, **env_kwargs).stepwise and name != "random":
            raise ValueError(f"{env_id} decides in every control step: its baseline is random, got {name!r}")
        method = make_method(name, env_id, **env_kwargs)
    usual = re.sub(r"[^-\w/]+", "-", f"{env_id.rpartition('-v')[0]}/{method.name}")  # a name of Minari
    dataset = f"{usual}-v0" if config.dataset is None else config.dataset
    found = record_dataset(dataset, env_id, env_kwargs, method, config.episodes, config.seed)
    print(f"{found.total_episodes} episodes, {found.total_steps} decisions: {dataset_folder(dataset)}")
    print(f"load them with minari.load_dataset({dataset!r})")


def dataset_folder(dataset_id: str) -> Path:
    """Return the folder of a dataset, in MINARI_DATASETS_PATH or, by default, in ~/.minari/datasets."""
    from minari.storage import get_dataset_path

    if not DATASET_ID.fullmatch(dataset_id):
        allowed = "letters, digits, - and _, two or more in a group"
        raise ValueError(f"dataset must be named like group/name-v0, of {allowed}, got {dataset_id!r}")
    return Path(get_dataset_path(dataset_id))


def record_dataset(
    dataset_id: str, env_id: str, env_kwargs: Mapping[str, Any], method: Method, episodes: int, seed: int = 0
) -> Any:
    """Record episodes of a method as a Minari dataset, such as group/name-v0, and return it.

    Episode i is reset with `seed + i`. Actions are in single precision, as the action space has them, so that a replay
    gives the same.

    Raises:
        ValueError: The dataset exists, its name is not allowed, or decisions of the method are no actions.
        ImportError: Minari is not installed.
    """
    import minari

    if method.name.rpartition(":")[2] in PLANNERS:
        raise ValueError(f"movements of {method.name} are no actions; those of an agent or search512 are")
    folder = dataset_folder(dataset_id)
    if folder.exists():
        raise ValueError(f"dataset {dataset_id} exists in {folder}; name another one, or a new version")
    with scene_progress() as progress, closing(gym.make(env_id, **env_kwargs)) as env:
        buffers = []
        for episode in range(episodes):
            buffers.append(_episode(env, method, episode, seed + episode))
            progress(method.name, episode + 1, episodes)
        told = f"{episodes} episodes of {method.name} in {env_id}, seeds {seed} to {seed + episodes - 1}"
        about: Any = {"algorithm_name": method.name, "description": told}
        with warnings.catch_warnings():
            # An author, a web address and an evaluation environment may be missing.
            warnings.simplefilter("ignore", UserWarning)
            try:
                return minari.create_dataset_from_buffers(dataset_id, buffers, env=env, **about)
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)  # a dataset is whole, or not there
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
