"""Checks of configurations and hyperparameters."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from viapoint.envs.common.validation import whole_number
from viapoint.envs.registration import ENV_IDS, OWN_ARM_TASKS, REPLANNING_TASKS, STEP_TASKS

DEFAULT_ENV = "viapoint/PlanarObstacles-v0"
SHIPPED = Path(str(files("viapoint.training") / "pretrained"))
"""Folder of the agents that come with the package."""
SHIPPED_IDS = tuple(f"viapoint/{path.parent.name}" for path in sorted(SHIPPED.glob("*/model.json")))
"""Ids of environments with a shipped agent."""

BASELINES = (
    "untrained", "straight", "constant", "random", "random16", "random80", "planner", "ompl", "unrevised",
    "search16", "search64", "search512", "search4096",
)  # fmt: skip
"""Names of baselines; not every environment has each of them."""
ELSEWHERE = {
    "num_envs": "--n-envs says how many environments are stepped together",
    "seed": "--seed is that of everything",
    "observe_candidates": "--observe-candidates says how many candidates are observed",
    "env_id": "--env names the environment",
    "id": "--env names the environment",
    "render_mode": "viapoint play films",
    "vectorization_mode": "the environments are native vector environments",
    "vector_kwargs": "the environments are native vector environments",
    "wrappers": "the environments are trained on as they are",
    "workers": "--rollout-workers shares the environments among processes",
    "on": "--on names the place of rollout workers",
}
"""Arguments that a training's environment does not take, and what to use instead."""
GREATEST = {"seed": 2**32 - 1, "n_envs": 1 << 16, "num_envs": 1 << 16, "port": 65535}
"""Greatest values: seeds of NumPy's legacy generator, environments that fit into memory, and ports."""


def check_env(env: str) -> None:
    """Check that an id is one of this package's."""
    if env not in ENV_IDS:
        raise ValueError(
            f"env must be one of {', '.join(ENV_IDS)}, which `import viapoint.envs` registers; got {env!r}"
        )


def check_env_kwargs(kwargs: Mapping[str, Any]) -> None:
    """Check that no argument has a flag of its own; the environment checks the others."""
    if not isinstance(kwargs, Mapping):
        raise ValueError(f"env_kwargs must be values by name, got {kwargs!r}")
    for name in kwargs:
        if name in ELSEWHERE:
            raise ValueError(f"{name} cannot be among env_kwargs: {ELSEWHERE[name]}")


def check_rollout_workers(workers: int, on: str, n_envs: int | None) -> None:
    """Check the number of rollout workers and their place."""
    if on not in ("local", "ray") and not on.startswith("ray://"):
        raise ValueError(f"on must be local, ray or ray://HOST:PORT, got {on!r}")
    if on != "local" and not workers:
        raise ValueError(f"on={on} needs rollout workers; give their number, such as rollout_workers=2")
    if n_envs is not None and workers > n_envs:
        raise ValueError(f"rollout_workers must be at most n_envs, which is {n_envs}, got {workers}")


def check_whole_movements(env: str) -> None:
    """Check that an action of the task is a whole movement."""
    if env in STEP_TASKS or env in REPLANNING_TASKS:
        like = STEP_TASKS.get(env, DEFAULT_ENV)
        raise ValueError(f"env must be one where an action is a whole movement, {like} for one, got {env!r}")


def check_has_scenes(env: str) -> None:
    """Check that scenes are shipped for a task."""
    if env in OWN_ARM_TASKS:
        raise ValueError(f"env must be one with frozen scenes, {OWN_ARM_TASKS[env]} for one, got {env!r}")


def check_whole(name: str, value: Any, least: int) -> int:
    """Return a whole number from `least` to its greatest value."""
    return whole_number(name, value, least, GREATEST.get(name))


def check_observed(number: int, algo: str, env: str) -> None:
    """Check that an algorithm can observe candidates in an environment."""
    if number and (algo == "viaq" or env in STEP_TASKS):
        raise ValueError(
            "observe_candidates must be 0 for viaq, which checks candidates itself, and for actions in every "
            f"control step, got {number} for {algo} on {env}"
        )


def check_stalling(share: Any, asked: int | None, interval: int, limits: tuple[int, int]) -> None:
    """Check the settings of a training that ends when it stalls.

    Args:
        share: Share of the decisions without a rise of success; None for a training that does not end early.
        asked: `min_timesteps` as given.
        interval: Decisions between two validations, 0 for none.
        limits: Fewest and most decisions.
    """
    if share is None:
        if asked is not None:
            raise ValueError("min_timesteps needs stop_when_stalled, such as 0.3")
        return
    if not _is_number(share) or not 0.0 < share < 1.0:
        raise ValueError(f"stop_when_stalled must be a number over 0 and below 1, got {share!r}")
    if not interval:
        raise ValueError("stop_when_stalled needs validations: eval_every must be 1 or more, got 0")
    if limits[0] >= limits[1]:
        raise ValueError(
            f"n_timesteps must be over min_timesteps ({limits[0]}) with stop_when_stalled, got {limits[1]}"
        )


def check_baselines(names: tuple[str, ...]) -> None:
    """Check that baselines exist and differ, as a table has one row for each."""
    for name in names:
        if name not in BASELINES:
            raise ValueError(f"baselines must be some of {', '.join(BASELINES)}, got {name!r}")
        if names.count(name) > 1:
            raise ValueError(f"baselines must differ, {name} is there twice")


def check_file(name: str, path: Path | None, suffix: str = "") -> None:
    """Check that a file can be written."""
    if path is None:
        return
    if suffix and path.suffix.lower() != suffix:
        raise ValueError(f"{name} must end in {suffix}, got {path}")
    if os.path.isdir(path):
        raise ValueError(f"{name} must be a file, and {path} is a folder")
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError(f"{name} must be a file, and {path} is something else")
    _check_place(name, path, path.parent)


def check_folder(name: str, path: Path | None) -> None:
    """Check that a folder can be written to."""
    if path is not None:
        _check_place(name, path, path)


def _check_place(name: str, path: Path, folder: Path) -> None:
    """Check that a folder exists or can be created, and can be written to."""
    there = next(each for each in (folder.absolute(), *folder.absolute().parents) if os.path.exists(each))
    if not os.path.isdir(there):
        raise ValueError(f"{name} {path} cannot be written: {there} is no folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ValueError(f"{name} {path} cannot be written: nothing may be written in {there}")


class Allowed(NamedTuple):
    """Allowed values of one hyperparameter."""

    words: str
    """Words of error messages after "must be"."""
    fits: Callable[[Any], bool]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any, least: int) -> bool:
    return type(value) is int and value >= least


def _whole(least: int) -> Allowed:
    return Allowed(f"a whole number, {least} or more", lambda value: _is_whole(value, least))


def _or(one: Allowed, other: Allowed) -> Allowed:
    return Allowed(f"{one.words}, or {other.words}", lambda value: one.fits(value) or other.fits(value))


def _is_linear(value: Any) -> bool:
    return (
        isinstance(value, Mapping)
        and set(value) == {"kind", "start", "end", "end_fraction"}
        and value["kind"] == "linear"
        and all(_is_number(value[name]) and value[name] >= 0 for name in ("start", "end"))
        and _is_number(value["end_fraction"])
        and 0 < value["end_fraction"] <= 1
    )


def _is_normal(value: Any) -> bool:
    named = isinstance(value, Mapping) and set(value) == {"kind", "sigma"} and value["kind"] == "normal"
    return named and _is_number(value["sigma"]) and value["sigma"] >= 0


def _is_automatic(value: Any) -> bool:
    found = re.fullmatch(r"auto(_(?P<start>[0-9.]+(e-?[0-9]+)?))?", value) if isinstance(value, str) else None
    try:
        return found is not None and float(found["start"] or 1.0) > 0.0
    except ValueError:
        return False


def _is_steps(value: Any) -> bool:
    pair = isinstance(value, list | tuple) and len(value) == 2 and value[1] == "step"
    return _is_whole(value, 1) or (pair and _is_whole(value[0], 1))


FLAG = Allowed("true or false", lambda value: isinstance(value, bool))
NONE = Allowed("null", lambda value: value is None)
POSITIVE = Allowed("a number greater than 0", lambda value: _is_number(value) and value > 0)
NOT_NEGATIVE = Allowed("a number, 0 or more", lambda value: _is_number(value) and value >= 0)
FINITE = Allowed("a number", _is_number)
LINEAR = Allowed('{"kind":"linear","start":S,"end":E,"end_fraction":F}', _is_linear)
NORMAL = Allowed('{"kind":"normal","sigma":S}', _is_normal)
AUTOMATIC = Allowed('"auto" or "auto_START"', _is_automatic)
AUTO = Allowed('"auto"', lambda value: value == "auto")
STEPS = Allowed('a whole number, 1 or more, or [N,"step"]', _is_steps)
SETTINGS = Allowed('settings by name, {"net_arch":[256,256]}', lambda value: isinstance(value, Mapping))
SHARE = Allowed("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= 1)

HYPERPARAMETERS: dict[str, Allowed] = {
    "learning_rate": _or(POSITIVE, LINEAR),
    "gamma": SHARE,
    "batch_size": _whole(1),
    "policy_kwargs": _or(SETTINGS, NONE),
    # of algorithms with a replay buffer
    "buffer_size": _whole(1),
    "learning_starts": _whole(0),
    "train_freq": STEPS,
    "gradient_steps": _whole(-1),  # -1: as many as there were steps
    "tau": SHARE,
    "n_steps": _whole(1),
    "action_noise": _or(NORMAL, NONE),
    "optimize_memory_usage": FLAG,
    # TD3
    "policy_delay": _whole(1),
    "target_policy_noise": NOT_NEGATIVE,
    "target_noise_clip": NOT_NEGATIVE,
    # SAC and TQC
    "ent_coef": _or(NOT_NEGATIVE, AUTOMATIC),
    "target_entropy": _or(FINITE, AUTO),
    "target_update_interval": _whole(1),
    "top_quantiles_to_drop_per_net": _whole(0),
    "use_sde": FLAG,
    "use_sde_at_warmup": FLAG,
    "sde_sample_freq": _whole(-1),  # -1: at the beginning only
    # PPO
    "n_epochs": _whole(1),
    "gae_lambda": SHARE,
    "clip_range": _or(POSITIVE, LINEAR),
    "clip_range_vf": _or(_or(POSITIVE, LINEAR), NONE),
    "normalize_advantage": FLAG,
    "vf_coef": NOT_NEGATIVE,
    "max_grad_norm": POSITIVE,
    "target_kl": _or(POSITIVE, NONE),
    # ViaQ
    "explore_uniformly": SHARE,
    "temperature": POSITIVE,
    "explore_candidates": _whole(2),
    "next_candidates": _whole(1),
}
"""Allowed values by name, for every algorithm; Stable-Baselines3 and ViaQ document them."""

PARTICULAR: dict[str, dict[str, Allowed]] = {
    "ppo": {"ent_coef": NOT_NEGATIVE, "batch_size": _whole(2)},
    "viaq": {
        "action_noise": Allowed("null, as it explores by itself", NONE.fits),
        "n_steps": Allowed("1", lambda value: value == 1 and not isinstance(value, bool)),
        "optimize_memory_usage": Allowed("false", lambda value: value is False),
        "use_sde": Allowed("false", lambda value: value is False),
    },
}
"""Allowed values that are narrower for one algorithm."""

VIA_POLICY: dict[str, Allowed] = {
    "form": Allowed("poses or action", lambda value: value in ("poses", "action")),
    "pooling": Allowed("minimum or sum", lambda value: value in ("minimum", "sum")),
    "heads": _whole(1),
    "width": _or(_whole(1), NONE),
    "instants": _or(_whole(2), NONE),
    "candidates": _whole(1),
    "refinements": _whole(0),
    "per_refinement": _whole(1),
    "checks": _whole(0),
    "optimizer_kwargs": _or(SETTINGS, NONE),
}
"""Allowed `policy_kwargs` of ViaQ by name; the environment provides the task."""


def check_hyperparameters(algo: str, values: Mapping[str, Any]) -> None:
    """Check the values of hyperparameters; building the model checks their names."""
    if not isinstance(values, Mapping):
        raise ValueError(f"hyperparameters must be values by name, got {values!r}")
    table = {**HYPERPARAMETERS, **PARTICULAR.get(algo, {})}
    _check(f"of {algo}", table, values)
    if algo == "viaq":
        policy = values.get("policy_kwargs") or {}
        unknown = sorted(set(policy) - set(VIA_POLICY))
        if unknown:
            raise ValueError(
                f"policy_kwargs of viaq have no {unknown[0]!r}; they have {', '.join(VIA_POLICY)}"
            )
        check_via_policy(policy)


def check_via_policy(values: Mapping[str, Any]) -> None:
    """Check the values of `policy_kwargs` of ViaQ; unknown names are ignored."""
    _check("in policy_kwargs of viaq", VIA_POLICY, values)
    if values.get("form", "poses") == "poses" and values.get("pooling", "minimum") != "minimum":
        raise ValueError(
            "hyperparameter pooling in policy_kwargs of viaq must be minimum where the form is poses, got "
            f"{values['pooling']!r}"
        )


def _check(where: str, table: Mapping[str, Allowed], values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if name in table and not table[name].fits(value):
            raise ValueError(f"hyperparameter {name} {where} must be {table[name].words}, got {value!r}")
