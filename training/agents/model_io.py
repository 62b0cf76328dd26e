"""Model folders: agents as JSON and safetensors, which hold numbers and names but no code.

model.json             algorithm, policy, environment and hyperparameters
weights.safetensors    tensors of the policy
arm.xml                copy of the arm, if it was loaded from a file
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import inspect
import json
import math
import types
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch.nn.modules.module import register_module_parameter_registration_hook
from typeguard import CollectionCheckStrategy, TypeCheckError, check_type

from viapoint.envs.arms.stored import keep_arm, with_kept_arm
from viapoint.envs.common.validation import is_number, whole_number
from viapoint.envs.task import Task
from viapoint.training.agents.extractors import SceneExtractor
from viapoint.training.files import (
    BadFileError,
    as_plain,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
    written_by,
)
from viapoint.training.planning.candidates import MOST_CANDIDATES, MOST_ROUNDS
from viapoint.training.planning.movements import INSTANTS
from viapoint.training.vec_env import ViaVecEnv, check_spaces, env_arguments

ACTIVATIONS = (torch.nn.ReLU, torch.nn.Tanh, torch.nn.ELU, torch.nn.SiLU, torch.nn.GELU)
# Classes that model files name, by kind and name
CLASSES: dict[str, dict[str, type[torch.nn.Module]]] = {
    "activation": {each.__name__: each for each in ACTIVATIONS},
    "extractor": {"SceneExtractor": SceneExtractor},
}
FORMAT = 1  # Version of the two files
# Learning algorithms by their names on the command line; the modules that define them add them
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {}
# Arguments of algorithms that model files do not hold
NOT_STORED = frozenset(
    {"self", "policy", "env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
    | {"stats_window_size", "monitor_wrapper", "sde_support", "support_multi_env", "supported_action_spaces"}
    | {"replay_buffer_class", "replay_buffer_kwargs", "rollout_buffer_class", "rollout_buffer_kwargs"}
)

# Hyperparameters that must be greater than zero
POSITIVE = frozenset({"learning_rate", "temperature", "clip_range", "max_grad_norm"})
# Least and greatest values of others
LIMITS: dict[str, tuple[float, float]] = {
    "gradient_steps": (-1, math.inf),  # -1: as many as there were steps of the environment
    **dict.fromkeys(("gamma", "gae_lambda", "tau", "explore_uniformly"), (0, 1)),
    **dict.fromkeys(("learning_starts", "target_policy_noise", "target_noise_clip"), (0, math.inf)),
    **dict.fromkeys(("ent_coef", "vf_coef", "top_quantiles_to_drop_per_net", "checks"), (0, math.inf)),
    **dict.fromkeys(("buffer_size", "train_freq", "n_steps", "n_epochs"), (1, math.inf)),
    "batch_size": (1, 1 << 16),  # rows are drawn with replacement: larger batches repeat them
    **dict.fromkeys(("policy_delay", "target_update_interval", "width"), (1, math.inf)),
    # Time and memory of a decision grow with these
    **dict.fromkeys(("candidates", "per_refinement", "next_candidates"), (1, MOST_CANDIDATES)),
    **dict.fromkeys(("explore_candidates", "labels"), (2, MOST_CANDIDATES)),
    "refine": (0, MOST_CANDIDATES),
    "refinements": (0, MOST_ROUNDS),
    "instants": (2, INSTANTS),
    "nearest": (1, 1024),
}

LARGEST_MODEL_JSON = 1 << 20  # Greatest size of `model.json`, [bytes]
LARGEST_WEIGHTS = 1 << 30  # Greatest size of `weights.safetensors`, [bytes]
ANY_TASK = "viapoint/Obstacles-v0"  # Id of an environment that can be any task
# Number of parameters beyond its weights up to which a model is built, so that the error names the tensor
SPARE_PARAMETERS = 100_000


def save_model(model: BaseAlgorithm, folder: Path) -> None:
    """Write a model as JSON and safetensors, for decisions and for further training from its weights."""
    normalize = model.get_vec_normalize_env()
    if normalize is not None and normalize.norm_obs:
        warnings.warn(
            "a model folder does not hold the statistics of VecNormalize, without which the loaded model decides on "
            "raw observations; keep them with VecNormalize.save",
            stacklevel=3,
        )
    path = folder / "weights.safetensors"
    write_arrays(path, weights(model))
    keep_arm(folder, _task_of(model.get_env()).arm)
    write_json(folder / "model.json", {**describe(model), "weights_sha256": _digest(path)})


def load_model(folder: Path, env: VecEnv | None = None) -> BaseAlgorithm:
    """Load a model to train it on `env`, or to decide, with an environment and a small replay buffer of its own.

    Files that are missing, torn, foreign, or say something that is not allowed raise BadFileError, another environment
    than the agent needs ValueError.
    """
    path = folder / "model.json"
    tensors = folder / "weights.safetensors"
    record = read_json(path, LARGEST_MODEL_JSON)
    written = written_by(record.get("viapoint"))
    if record.get("format") != FORMAT:
        raise BadFileError(path, f"must have format {FORMAT}, got {record.get('format')!r}{written}")
    arrays = read_arrays(tensors, LARGEST_WEIGHTS)
    try:
        # An arm file that is gone is replaced by its copy; ViaQ's networks know the task, too.
        kept = functools.partial(with_kept_arm, folder=folder)
        record = json.loads(json.dumps(record), object_hook=kept)
        hyperparameters = dict(record["hyperparameters"])
        with warnings.catch_warnings(), _parameter_budget(arrays):
            warnings.simplefilter("ignore", UserWarning)  # PPO's batches do not fill one environment
            own = _own_environment(record["env"], folder)
            if env is None:
                hyperparameters = _to_decide(hyperparameters)
            else:
                check_spaces(own, env)
                check_same_task(_task_of(own), _task_of(env))
            model = build(record["algorithm"], record["policy"], env or own, hyperparameters)
        model.num_timesteps = whole_number("num_timesteps", record["num_timesteps"], 0)
    except BadFileError:
        raise
    except Exception as error:
        made = record.get("env")
        name = made.get("id") if isinstance(made, Mapping) else None
        if isinstance(name, str) and name not in gym.registry:
            written += f"; import the module that registers {name}, on the command line --env MODULE:{name}"
        if env is not None:
            load_model(folder)  # raises the error of the file if that is to blame
            raise ValueError(f"env does not fit the agent in {folder}: {error}") from None
        reason = f"does not describe a model that can be built here ({type(error).__name__}: {error})"
        raise BadFileError(path, reason + written) from None
    _put_weights(model, arrays, tensors)
    if record.get("weights_sha256") != _digest(tensors):
        raise BadFileError(tensors, "is damaged: its hash is not the one that model.json states")
    return model


def _task_of(env: Any) -> Task:
    """Return the task of a vector environment."""
    task: Task = env.get_attr("task", [0])[0]
    return task


def check_same_task(mine: Task, theirs: Task) -> None:
    """Check that observations and actions mean the same in two tasks, so that an agent of one can decide in the other.

    Scenes, rewards, and noise of a sensor may differ; ValueError names the parts that differ otherwise.
    """
    before, after = _meaning(mine), _meaning(theirs)
    if mine.arm.xml == theirs.arm.xml:  # one arm may be in several files
        after["arm"] = before["arm"]
    others = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    if others:
        raise ValueError(
            f"the environment must have the same {', '.join(others)} as the agent: "
            f"{ {name: before.get(name) for name in others} }, got { {name: after.get(name) for name in others} }"
        )


def _meaning(task: Task) -> dict[str, Any]:
    """Return the parts of a task on which the meaning of observations and actions depends."""
    record = task.as_dict()
    parts = {name: record[name] for name in ("arm", "space")}
    parts["decide_at"] = "events" if task.replanning else task.decide_at
    if task.stepwise:
        parts["control_step"] = task.control_step
    else:
        parts |= {name: getattr(task, name) for name in ("n_via", "timing", "duration_range", "via_range")}
    if task.sensor is None:
        parts["shapes"] = record["shapes"]
        parts["greatest n_obstacles"] = task.n_obstacles[1]
    else:
        parts["sensor"] = {**record["sensor"], "noise": 0.0, "dropped": 0.0}
    return parts


def build(
    algorithm: str,
    policy: str,
    env: VecEnv,
    hyperparameters: Mapping[str, Any],
    *,
    seed: int | None = None,
) -> BaseAlgorithm:
    """Build a new model; hyperparameters are JSON values, as :func:`describe` writes them, checked here."""
    if algorithm not in ALGORITHMS:
        raise ValueError(f"algorithm must be one of {', '.join(ALGORITHMS)}, got {algorithm!r}")
    kind = ALGORITHMS[algorithm]
    policies: dict[str, type[BasePolicy]] = kind.policy_aliases
    if policy not in policies:
        raise ValueError(f"policy of {algorithm} must be one of {', '.join(policies)}, got {policy!r}")
    check_hyperparameters(algorithm, hyperparameters)
    size = int(np.prod(env.action_space.shape or ()))
    arguments = {name: _decode(value, size) for name, value in hyperparameters.items()}
    return kind(policies[policy], env, seed=seed, device="cpu", **arguments)


def check_hyperparameters(algorithm: str, hyperparameters: Mapping[str, Any]) -> None:
    """Check the names, types and ranges of hyperparameters of an algorithm; ValueError otherwise."""
    kind = ALGORITHMS[algorithm]
    allowed = _argument_names(kind)
    for name in sorted(set(hyperparameters) - allowed):
        raise ValueError(f"{algorithm} has no hyperparameter {name!r}; it has {', '.join(sorted(allowed))}")
    check_arguments(kind, {name: _decode(value, 1) for name, value in hyperparameters.items()})


def check_arguments(function: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Check values against the type hints of a function or class, and numbers against their ranges.

    The algorithms accept any number, and many a wrong one shows only as a training that does not learn.
    """
    hints = _hints(function)
    for name, value in values.items():
        number = value.item() if isinstance(value, np.generic) else value
        hint = hints.get(name, Any)
        try:
            check_type(number, hint, collection_check_strategy=CollectionCheckStrategy.ALL_ITEMS)
        except TypeCheckError:
            kinds = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
            wanted = " or ".join(map(inspect.formatannotation, kinds))
            raise ValueError(f"{name} must be {wanted}, got {value!r}") from None
        if isinstance(number, bool) and bool not in (hint, *typing.get_args(hint)):
            raise ValueError(f"{name} must be a number, got {value!r}")  # a bool counts as an int for Python
        if name == "train_freq" and isinstance(number, tuple):
            number, unit = number
            if unit != "step":  # episodes end at different times in several environments
                raise ValueError(f"{name} must count steps, got {value!r}")
        if not is_number(number):
            continue
        if not math.isfinite(number):
            raise ValueError(f"{name} must be finite, got {value!r}")
        if name in POSITIVE and number <= 0:
            raise ValueError(f"{name} must be greater than 0, got {value!r}")
        if name == "gradient_steps" and number == 0:
            raise ValueError("gradient_steps must not be 0: the network would never be updated")
        least, most = LIMITS.get(name, (-math.inf, math.inf))
        if not least <= number <= most:
            raise ValueError(f"{name} must be from {least:g} to {most:g}, got {value!r}")


@functools.cache
def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the type hints of a function, or of the arguments of a class."""
    # The hints of Stable-Baselines3 name VecEnv, which its modules import for type checkers only.
    hinted: Any = getattr(function, "__init__") if isinstance(function, type) else function  # noqa: B009
    return typing.get_type_hints(hinted, localns={"VecEnv": object})


def untrained(model: BaseAlgorithm, seed: int = 0) -> BaseAlgorithm:
    """Return a model like this one before its training, with the weights of a seed."""
    record, env = describe(model), model.get_env()
    assert env is not None
    hyperparameters = _to_decide(record["hyperparameters"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # as in load_model
        return build(record["algorithm"], record["policy"], env, hyperparameters, seed=seed)


def _to_decide(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters with hardly any room for experience, which decisions do not need."""
    for name in ("buffer_size", "n_steps"):  # the second one is another thing where there is a replay buffer
        if name in hyperparameters:
            return {**hyperparameters, name: 2}
    return dict(hyperparameters)


def describe(model: BaseAlgorithm) -> dict[str, Any]:
    """Return everything but the weights as JSON values."""
    name = next((each for each, kind in ALGORITHMS.items() if issubclass(kind, type(model))), None)
    if name is None:
        known = ", ".join(kind.__name__ for kind in ALGORITHMS.values())
        raise ValueError(f"only agents of {known} can be saved, got {type(model).__name__}")
    env_id, env_kwargs = env_arguments(model.get_env())
    policies = {kind: each for each, kind in ALGORITHMS[name].policy_aliases.items()}
    stored = sorted(each for each in _argument_names(type(model)) if hasattr(model, each))
    limit = gym.spec(env_id).max_episode_steps  # of an id of one's own
    return {
        "format": FORMAT,
        "viapoint": importlib.metadata.version("viapoint"),
        "algorithm": name,
        "policy": policies[model.policy_class],
        "env": {
            "id": env_id,
            "kwargs": _encode(env_kwargs),
            "task": _task_of(model.get_env()).as_dict(),
            **({} if limit is None else {"max_episode_steps": limit}),
        },
        "num_timesteps": model.num_timesteps,
        "hyperparameters": {each: _encode(getattr(model, each)) for each in stored},
    }


def weights(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the tensors of :func:`_tensors` as arrays."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in _tensors(model).items()}


def _tensors(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Return the tensors of a model by name: those of the policy, and coefficients that SAC and TQC learn."""
    _, others = model._get_torch_save_params()
    return {**model.policy.state_dict(), **{name: getattr(model, name) for name in others}}


def _put_weights(model: BaseAlgorithm, arrays: Mapping[str, Any], path: Path) -> None:
    """Set the tensors of :func:`_tensors` after checking names, shapes, types and values of all of them."""
    wanted = _tensors(model)
    there, needed = _shapes(arrays), _shapes(weights(model))
    for name in sorted({*there, *needed}):
        found, must = there.get(name, "absent"), needed.get(name, "absent")
        if found != must:
            raise BadFileError(path, f"tensor {name!r} must be {must}, is {found}")
        if not np.isfinite(arrays[name]).all():
            raise BadFileError(path, f"tensor {name!r} holds values that are not finite")
    with torch.no_grad():
        for name, array in arrays.items():
            wanted[name].copy_(torch.from_numpy(array))


def _shapes(arrays: Mapping[str, Any]) -> dict[str, str]:
    """Return types and shapes of arrays as text."""
    return {name: f"{array.dtype} {array.shape}" for name, array in arrays.items()}


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _own_environment(record: Mapping[str, Any], folder: Path) -> ViaVecEnv:
    """Return one copy of the environment that a file names by `id` and `kwargs`, which must have its `task`.

    The id of a user's own environment need not be registered where the model is loaded; one of another task raises
    BadFileError.
    """
    env_id, kwargs, task = record["id"], record["kwargs"], record["task"]
    if env_id not in gym.registry:  # never lets Gymnasium import a module named in a file
        limit = kwargs.get("max_episode_steps", record.get("max_episode_steps"))
        env_id, kwargs = ANY_TASK, {**task}
        if limit is not None:
            kwargs["max_episode_steps"] = limit
    env = ViaVecEnv(env_id, 1, **kwargs)
    env.recorded_id = record["id"]
    try:
        check_same_task(Task.of(**task), _task_of(env))
    except ValueError as error:
        reason = f"holds an agent for another {env_id} than is registered: {error}"
        raise BadFileError(folder, reason) from None
    return env


@contextmanager
def _parameter_budget(arrays: Mapping[str, Any]) -> Iterator[None]:
    """Limit the parameters of new networks to the number in the weights, plus a few; ValueError otherwise.

    Torch reserves memory for a layer before it touches it, and the check comes between the two.
    """
    there = sum(array.size for array in arrays.values())
    left = there + SPARE_PARAMETERS

    def count(module: torch.nn.Module, name: str, parameter: torch.nn.Parameter | None) -> None:
        nonlocal left
        left -= parameter.numel() if parameter is not None else 0
        if left < 0:
            raise ValueError(f"it describes larger networks than the {there} parameters in the weights")

    handle = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        handle.remove()  # other networks may have any size


def _argument_names(kind: type[BaseAlgorithm]) -> set[str]:
    """Return the names of an algorithm's hyperparameters."""
    every = inspect.signature(kind.__init__).parameters.values()
    return {each.name for each in every if each.kind is not each.VAR_KEYWORD} - NOT_STORED


def _encode(value: Any) -> Any:
    """Return a value as JSON; objects become {"kind": ..., ...}."""
    if isinstance(value, FloatSchedule):
        return _encode(value.value_schedule)
    if isinstance(value, ConstantSchedule):
        return value.val
    if isinstance(value, LinearSchedule):
        return {"kind": "linear", "start": value.start, "end": value.end, "end_fraction": value.end_fraction}
    if isinstance(value, VectorizedActionNoise):
        return _encode(value.base_noise)
    if isinstance(value, NormalActionNoise):
        return {"kind": "normal", "sigma": float(np.max(value._sigma))}
    for kind, classes in CLASSES.items():
        if isinstance(value, type) and value in classes.values():
            return {"kind": kind, "name": value.__name__}
    if isinstance(value, Mapping):
        return {str(name): _encode(each) for name, each in value.items()}
    if hasattr(value, "frequency"):  # SB3's TrainFreq
        return [value.frequency, value.unit.value]
    if isinstance(value, list | tuple):
        return [_encode(each) for each in value]
    return as_plain(value)  # an arm of one's own by its name; whoever loads the model makes it known first


def _decode(value: Any, size: int) -> Any:
    """Invert :func:`_encode`; `size` is the number of components of an action."""
    if isinstance(value, Mapping):
        kind = value.get("kind")
        if kind == "linear":
            return LinearSchedule(float(value["start"]), float(value["end"]), float(value["end_fraction"]))
        if kind == "normal":
            sigma = float(value["sigma"])
            if not sigma >= 0.0:
                raise ValueError(f"sigma of action_noise must be 0 or more, got {sigma}")
            return NormalActionNoise(np.zeros(size), np.full(size, sigma))
        if kind in CLASSES:
            return CLASSES[kind][value["name"]]
        if kind is not None:
            raise ValueError(f"kind must be linear, normal, activation or extractor, got {kind!r}")
        return {name: _decode(each, size) for name, each in value.items()}
    if isinstance(value, list) and len(value) == 2 and isinstance(value[1], str):
        return tuple(value)
    return [_decode(each, size) for each in value] if isinstance(value, list) else value
