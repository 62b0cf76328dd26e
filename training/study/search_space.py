"""Description of a hyperparameter search: what is trained, which parameters vary, and how they are chosen."""

from __future__ import annotations

import copy
import inspect
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler

from viapoint.training.config.base import Config
from viapoint.training.config.checks import check_whole
from viapoint.training.config.configs import TrainConfig
from viapoint.training.config.presets import Algorithm
from viapoint.training.io.files import BadFileError, read_yaml

Made = TypeVar("Made")

SAMPLERS: dict[str, type[BaseSampler]] = {
    "tpe": optuna.samplers.TPESampler,
    "random": optuna.samplers.RandomSampler,
}
"""Samplers of Optuna by name."""
PRUNERS: dict[str, type[BasePruner]] = {
    "none": optuna.pruners.NopPruner,
    "median": optuna.pruners.MedianPruner,
    "percentile": optuna.pruners.PercentilePruner,
    "successive_halving": optuna.pruners.SuccessiveHalvingPruner,
}
"""Pruners of Optuna by name; their steps are decisions."""
ERROR, ATTEMPTS = "error", "attempts"
"""Attributes of a trial: the reason why it cannot be trained; numbers of the earlier attempts at it."""
OBJECTIVES = ("final", "mean")
SHARED = ("env", "algo", "n_timesteps", "eval_every", "eval_scenes", "env_kwargs", "discount_unit")
"""Fields of a search that its trainings take over as they are."""
RANGES = {
    "float": {"low", "high", "log", "step"},
    "int": {"low", "high", "log", "step"},
    "categorical": {"choices"},
}
"""Fields of each type of parameter."""


@dataclass(frozen=True, kw_only=True)
class SearchSpace(Config):
    """Hyperparameter search, as a YAML file describes it.

    Raises:
        ValueError: A value is not allowed; the message lists the allowed values.

    Example:
        >>> from viapoint.training.study.search_space import SearchSpace
        >>> search = SearchSpace(
        ...     env="viapoint/PlanarReach-v0",
        ...     algo="sac",
        ...     n_timesteps=2_000,
        ...     parameters={"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True}},
        ... )
        >>> search.training({"learning_rate": 3e-3}, seed=0).hyperparameters
        {'learning_rate': 0.003}
    """

    env: str
    """Id of the environment."""
    algo: Algorithm = "viaq"
    """Learning algorithm."""
    n_timesteps: int
    """Decisions of each training."""
    parameters: Mapping[str, Any]
    """Type and range of each parameter by name. A name is a hyperparameter, `n_envs`, or a path into a hyperparameter
    that has parts, such as `learning_rate.start` and `policy_kwargs.net_arch`."""
    trials: int = 20
    """Number of trials in total."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trainings of each trial; its score is their mean."""
    first: tuple[Mapping[str, Any], ...] = ()
    """Parameters of the first trials, for example those of a preset."""
    objective: str = "final"
    """Score of a training: `final`, the success rate at its last validation, or `mean`, the mean over its validations
    after the one before training."""
    sampler: Mapping[str, Any] = field(default_factory=lambda: {"name": "tpe"})
    """Name of the sampler, one of :data:`SAMPLERS`, and its arguments."""
    pruner: Mapping[str, Any] = field(default_factory=lambda: {"name": "median"})
    """Name of the pruner, one of :data:`PRUNERS`, and its arguments; it sees the validations of the first seed."""
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the environment."""
    n_envs: int | None = None
    """Environments that are stepped together; default: that of the preset."""
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    """Hyperparameters that all trials share, in place of those of the preset."""
    discount_unit: float | None = None
    """Time that gamma discounts once, [s]; default: that of the preset."""
    eval_every: int | None = None
    """Decisions between two validations; default: that of the preset."""
    eval_scenes: int = 500
    """Greatest number of validation scenes."""

    least: ClassVar = {"n_timesteps": 1, "trials": 1, "n_envs": 1, "eval_every": 1, "eval_scenes": 1}

    @classmethod
    def read(cls, path: Path) -> SearchSpace:
        """Read a YAML file.

        Raises:
            BadFileError: It is missing, no YAML, or describes no search; the message lists what is allowed.
        """
        try:
            record = read_yaml(path)
            for name in ("env", "n_timesteps", "parameters"):
                if name not in record:
                    raise ValueError(f"{name} is missing")
            return cls.from_json(record)
        except BadFileError:
            raise
        except (TypeError, ValueError) as error:
            raise BadFileError(path, f"describes no search: {error}") from None

    def _check(self) -> None:
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds must differ, and there must be at least one, got {list(self.seeds)}")
        for seed in self.seeds:
            check_whole("seed", seed, 0)
        if self.objective not in OBJECTIVES:
            raise ValueError(f"objective must be one of {', '.join(OBJECTIVES)}, got {self.objective!r}")
        self.make_sampler(0)
        self.make_pruner()
        if not isinstance(self.parameters, Mapping) or not self.parameters:
            raise ValueError("parameters must name at least one parameter with its range")
        ranges = self.distributions()
        for number, given in enumerate(self.first):
            _check_first(number, given, ranges)
        for ends in self.extremes():
            self.training(ends, self.seeds[0])

    def distributions(self) -> dict[str, BaseDistribution]:
        """Return the distributions of the parameters by name."""
        return {name: _distribution(name, given) for name, given in self.parameters.items()}

    def extremes(self) -> list[dict[str, Any]]:
        """Return parameters at the lower ends of all ranges, at the upper ends, and every choice at least once."""
        ranges = self.distributions()
        choices = [len(each.choices) for each in ranges.values() if isinstance(each, CategoricalDistribution)]
        return [
            {name: _value_at(each, i) for name, each in ranges.items()} for i in range(max([2, *choices]))
        ]

    def training(
        self, parameters: Mapping[str, Any], seed: int, out: Path | None = None, *, progress: bool = False
    ) -> TrainConfig:
        """Return the configuration of a training with given parameters.

        Raises:
            ValueError: A value is not allowed, or a path leads through something without parts.
        """
        usual = TrainConfig(env=self.env, algo=self.algo).preset.arguments()
        values = {name: plain(value) for name, value in parameters.items()}
        n_envs = values.pop("n_envs", self.n_envs)
        changed = copy.deepcopy(dict(self.hyperparameters))
        for name, value in values.items():
            top, *inner = name.split(".")
            changed[top] = _replaced(name, changed.get(top, usual.get(top)), inner, value)
        shared = {name: getattr(self, name) for name in SHARED}
        return TrainConfig(
            seed=seed, n_envs=n_envs, out=out, hyperparameters=changed, progress=progress, **shared
        )

    def make_sampler(self, number: int) -> BaseSampler:
        """Return the sampler of the trial with this number.

        Trials have samplers of their own, so that processes that share a search do not repeat one another, and a search
        that was interrupted goes on as if it had not been.
        """
        name, arguments = _named("sampler", self.sampler, SAMPLERS)
        seed = arguments.pop("seed", 0)
        check_whole("seed", seed, 0)
        arguments["seed"] = (seed * 1_000_003 + number) % 2**32
        return _made("sampler", SAMPLERS[name], arguments)

    def make_pruner(self) -> BasePruner:
        """Return the pruner."""
        name, arguments = _named("pruner", self.pruner, PRUNERS)
        return _made("pruner", PRUNERS[name], arguments)

    def score(self, curve: list[dict[str, Any]]) -> float:
        """Return the score of a training from its learning curve."""
        rates = [record["success"]["rate"] for record in curve if record["decisions"]]
        return float(rates[-1] if self.objective == "final" else sum(rates) / len(rates))


def plain(value: Any) -> Any:
    """Return the value of a parameter; Optuna holds choices that are no numbers or words as JSON."""
    return json.loads(value[len(_JSON) :]) if isinstance(value, str) and value.startswith(_JSON) else value


_JSON = "json:"


def stored(value: Any) -> Any:
    """Return a value in the form that Optuna holds it in; :func:`plain` is the inverse."""
    return _JSON + json.dumps(value) if isinstance(value, list | tuple | Mapping) else value


def _replaced(name: str, old: Any, path: list[str], value: Any) -> Any:
    """Return `old` with the part at `path` replaced."""
    if not path:
        return value
    if old is not None and not isinstance(old, Mapping):
        raise ValueError(f"parameter {name}: {name.split('.')[0]} is {json.dumps(old)}, which has no parts")
    part = _replaced(name, (old or {}).get(path[0]), path[1:], value)
    return {**(old or {}), path[0]: part}


def _distribution(name: str, given: Any) -> BaseDistribution:
    """Return the distribution that a parameter's fields describe."""
    what = f"parameter {name}"
    kind = given.get("type") if isinstance(given, Mapping) else None
    if kind not in RANGES:
        raise ValueError(f"{what} must have a type, one of {', '.join(RANGES)}, got {given!r}")
    fields = {each: value for each, value in given.items() if each != "type"}
    unknown = sorted(set(fields) - RANGES[kind])
    if unknown:
        raise ValueError(f"{what} of type {kind} has {', '.join(sorted(RANGES[kind]))}, not {unknown[0]!r}")
    if kind == "categorical":
        choices = fields.get("choices")
        if not isinstance(choices, list | tuple) or len(choices) < 2:
            raise ValueError(f"{what}: choices must be a list of at least two values, got {choices!r}")
        return CategoricalDistribution([stored(each) for each in choices])
    for end in ("low", "high"):
        number: Any = fields.get(end)
        right = isinstance(number, int if kind == "int" else int | float) and not isinstance(number, bool)
        if not right or not math.isfinite(number):
            raise ValueError(f"{what}: {end} must be a number of type {kind}, got {number!r}")
    if not fields["low"] < fields["high"]:
        raise ValueError(f"{what}: low must be less than high, got {fields['low']} and {fields['high']}")
    try:
        return FloatDistribution(**fields) if kind == "float" else IntDistribution(**fields)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {error}") from None


def _value_at(distribution: Any, index: int) -> Any:
    if isinstance(distribution, CategoricalDistribution):
        return distribution.choices[index % len(distribution.choices)]
    return distribution.high if index else distribution.low


def _check_first(number: int, given: Any, ranges: Mapping[str, BaseDistribution]) -> None:
    """Check that the given parameters of a trial exist and are in range."""
    if not isinstance(given, Mapping):
        raise ValueError(f"first must be a list of values by name, got {given!r}")
    for name, value in given.items():
        if name not in ranges:
            raise ValueError(f"first names {name!r}, and parameters are {', '.join(ranges)}")
        try:
            fits = ranges[name]._contains(ranges[name].to_internal_repr(stored(value)))
        except (TypeError, ValueError):
            fits = False
        if not fits:
            raise ValueError(f"first has {name} = {value!r} in its entry {number}, which is out of range")


def _named(what: str, given: Any, known: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return name and arguments of a sampler or pruner."""
    record = {"name": given} if isinstance(given, str) else given
    name = record.get("name") if isinstance(record, Mapping) else None
    if not isinstance(name, str) or name not in known:
        raise ValueError(f"{what} must have a name, one of {', '.join(known)}, got {given!r}")
    return name, {each: value for each, value in record.items() if each != "name"}


def _made(what: str, kind: type[Made], arguments: Mapping[str, Any]) -> Made:
    allowed = [name for name in inspect.signature(kind).parameters if name not in ("args", "kwargs")]
    unknown = sorted(set(arguments) - set(allowed))
    if unknown:
        raise ValueError(
            f"{what} {kind.__name__} has {', '.join(allowed) or 'no arguments'}, not {unknown[0]!r}"
        )
    try:
        return kind(**arguments)
    except (TypeError, ValueError, AssertionError) as error:
        raise ValueError(f"{what} {kind.__name__}: {error}") from None
