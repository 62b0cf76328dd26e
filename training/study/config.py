"""Description of a study, read from YAML: environments, agents, baselines and searches for hyperparameters.

Everything is checked when the file is read, so that a mistake in its last line is an error before the first training.
docs/studies.md explains the fields.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from viapoint.envs.common.validation import is_number
from viapoint.training.agents import viaq as _viaq  # noqa: F401 - it and its imports fill the table of algorithms
from viapoint.training.agents.model_io import check_arguments, check_hyperparameters
from viapoint.training.config.checks import check_env_kwargs, check_whole, unknown_name
from viapoint.training.config.configs import TrainConfig
from viapoint.training.io.files import read_json, read_yaml
from viapoint.training.planning.baselines import factory
from viapoint.training.planning.search import registered_task
from viapoint.training.scene_sets import SEEDS, SETS, shipped_set

Values = Mapping[str, Any]
# Fields of a training that an agent may set
TRAINING_FIELDS = {each.name for each in dataclasses.fields(TrainConfig)}
TRAINING_FIELDS -= {"env", "seed", "out", "resume", "progress"}
MEASURED = ("test", "hard", "uniform")  # by default; models are selected on `validation`


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One row of the results for one seed: what a worker trains and measures."""

    environment: str  # Name of the environment in folders and tables
    env_id: str  # Id of the registered environment
    env_kwargs: Values = field(default_factory=dict)  # Arguments of the environment
    scenes: tuple[str, ...] = ()  # Names of the measured sets, or files of scenes
    n_scenes: int | None = None  # Number of scenes of each set, evenly spread over it; None for all
    row: str  # Name of the row, which is also that of its folder
    seed: int = 0
    training: Values = field(default_factory=dict)  # Fields of TrainConfig; empty for a baseline
    checks: tuple[int, ...] = (0,)  # Numbers of proposals that the agent checks, a row each
    refine: tuple[int, ...] = ()  # Numbers of proposals that the planner refines, a row each
    untrained: bool = False  # True to measure the network before training, too
    method: str = ""  # Name of a baseline; empty for an agent

    def folder(self, out: Path) -> Path:
        """Return the folder of the trial."""
        return out / self.environment.rpartition("/")[2] / self.row / f"seed-{self.seed}"

    def config(self, out: Path) -> TrainConfig:
        """Return the configuration of the training; `policy_kwargs` are merged with those of the preset."""
        given = {**self.training, "env_kwargs": {**self.env_kwargs, **self.training.get("env_kwargs", {})}}
        config = TrainConfig(env=self.env_id, seed=self.seed, out=self.folder(out), progress=False, **given)
        own = config.hyperparameters.get("policy_kwargs")
        if own is None:
            return config
        usual = config.preset.arguments().get("policy_kwargs", {})
        hyperparameters = {**config.hyperparameters, "policy_kwargs": {**usual, **own}}
        return dataclasses.replace(config, hyperparameters=hyperparameters)


@dataclass(frozen=True, kw_only=True)
class Search(Trial):
    """Search for hyperparameters of one algorithm in one environment; the fields of the trial are what all share."""

    parameters: Values  # range or list of values by the path of a field
    trials: int = 20
    first: tuple[Values, ...] = ()  # parameters of the first trials

    def with_parameters(self, values: Values, folder: Path) -> TrainConfig:
        """Return the configuration of a training with these parameters."""
        trial = dataclasses.replace(self, training=_with(self.training, values))
        return dataclasses.replace(trial.config(folder), out=folder)

    @property
    def key(self) -> str:
        """Name that changes with the description of the search."""
        plain = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return f"{self.row}-{hashlib.sha256(plain.encode()).hexdigest()[:10]}"

    def folder(self, out: Path) -> Path:
        """Return the folder of the search."""
        return super().folder(out).parent

    def is_finished(self, out: Path) -> bool:
        """Return True if the best parameters of this very search are there."""
        path = self.folder(out) / "best.json"
        return path.is_file() and read_json(path).get("key") == self.key


@dataclass(frozen=True, kw_only=True)
class Study:
    """Environments, trials and searches that a YAML file describes.

    Example:
        >>> from viapoint.training import Study
        >>> agents = {"sac": {"algo": "sac", "grid": {"hyperparameters.batch_size": [128, 256]}}}
        >>> given = {"environments": ["viapoint/PlanarReach-v0"], "agents": agents, "baselines": ["search64"]}
        >>> [trial.row for trial in Study.from_dict(given).trials]
        ['sac-batch_size=128', 'sac-batch_size=256', 'search64']
    """

    name: str
    out: Path  # Folder of all runs and results
    trials: tuple[Trial, ...]
    searches: tuple[Search, ...] = ()

    @classmethod
    def from_yaml(cls, path: str | Path) -> Study:
        """Read a study from a YAML file.

        Raises:
            ValueError: The file cannot be read, or something in it is not allowed; the message says what is.
        """
        path = Path(path).expanduser()
        given = read_yaml(path)
        try:
            return cls.from_dict(given, name=path.stem, folder=path.parent)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def from_dict(cls, given: Values, *, name: str = "study", folder: str | Path = ".") -> Study:
        """Return a study from plain values.

        Args:
            given: Values by the names of the YAML file's fields.
            name: Name of the study; its folder is `runs/<name>` if `given` has no `out`.
            folder: Folder of files of scenes.

        Raises:
            ValueError: Something is not allowed; the message says what is.
        """
        study: Study = _made("the study", _study, given, name, Path(folder))
        return study


def _made(where: str, make: Callable[..., Any], fields: Any, *args: Any) -> Any:
    """Return the result of a function of fields of a file; an error begins with the place in the file."""
    if not isinstance(fields, Mapping):
        raise ValueError(f"{where} must be values by name, got {fields!r}")
    parameters = inspect.signature(make).parameters
    known = [name for name, each in parameters.items() if each.kind == each.KEYWORD_ONLY]
    if "training" in parameters:
        known += sorted(TRAINING_FIELDS)
    for name in fields:
        if name not in known:
            raise ValueError(unknown_name(f"{where}: fields", name, known))
    try:
        check_arguments(make, fields)
        return make(*args, **fields)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from None


def _study(
    name: str,
    folder: Path,
    *,
    environments: Any,
    out: str = "",
    seeds: list[int] | None = None,
    agents: Any = None,
    baselines: Any = None,
    searches: Any = None,
    scenes: list[str] | None = None,
    n_scenes: int | None = None,
) -> Study:
    """Return a study; the fields are those of the file."""
    known = {}
    for env, fields in _entries("environments", environments):
        fields = {"scenes": scenes, "n_scenes": n_scenes, **fields}
        known[env] = _made(f"environments.{env}", _environment, fields, env, folder)
    found: list[Trial] = []
    rows: set[str] = set()
    kinds = (("agents", _agent, agents), ("baselines", _baseline, baselines), ("searches", _search, searches))
    for kind, make, given in kinds:
        for row, fields in _entries(kind, given or {}):
            if row in rows:
                raise ValueError(f"rows must have different names, {row} is there twice")
            rows.add(row)  # rows are folders, which must not be shared
            for env in _names(f"{row}: environments", fields.pop("environments", list(known))):
                if env not in known:
                    raise ValueError(unknown_name(f"{row}: environments", env, known))
                shared = {} if make is _baseline else {"seeds": seeds or [0]}
                found += _made(row, make, {**shared, **fields}, known[env], row)
    if not found:
        raise ValueError("there is nothing to do: give environments, and agents, baselines or searches")
    trials = [each for each in found if not isinstance(each, Search)]
    return Study(
        name=name,
        out=Path(out or f"runs/{name}").expanduser(),
        trials=tuple(sorted(trials, key=lambda trial: trial.seed)),
        searches=tuple(each for each in found if isinstance(each, Search)),
    )


def _entries(where: str, given: list[str] | Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and fields of each entry of a list or mapping, one for each point of its grid."""
    if not isinstance(given, list | Mapping):
        raise ValueError(f"{where} must be a list of names, or values by name, got {given!r}")
    entries = given if isinstance(given, Mapping) else dict.fromkeys(_names(where, given))
    for name, fields in entries.items():
        if not str(name).strip("/. ") or ".." in str(name) or str(name).startswith("/"):
            raise ValueError(f"names must be words, got {name!r}")
        if not isinstance(fields, Mapping | None):
            raise ValueError(f"{name} must be values by name, got {fields!r}")
        rest = dict(fields or {})
        grid = rest.pop("grid", {})
        if not isinstance(grid, Mapping) or not all(isinstance(values, list) for values in grid.values()):
            raise ValueError(f"grid of {name} must be lists by the path of a field, got {grid!r}")
        for values in itertools.product(*grid.values()):
            point = dict(zip(grid, values, strict=True))
            ends = [f"-{path.rpartition('.')[2]}={value}" for path, value in point.items()]
            yield f"{name}{''.join(ends)}", _with(rest, point)


def _names(where: str, given: Any) -> list[str]:
    """Return a list of names; something else raises ValueError."""
    if not isinstance(given, list):
        raise ValueError(f"{where} must be a list of names, got {given!r}")
    for each in given:
        if not isinstance(each, str):
            raise ValueError(
                f"{where} must be names, or a mapping from names to values, got {each!r} in a list"
            )
    return given


def _with(fields: Values, changes: Values) -> dict[str, Any]:
    """Return fields with other values by paths such as `hyperparameters.learning_rate`."""
    changed = dict(fields)
    for path, value in changes.items():
        first, _, rest = path.partition(".")
        changed[first] = _with(changed.get(first) or {}, {rest: value}) if rest else value
    return changed


def _environment(
    name: str,
    folder: Path,
    *,
    id: str = "",  # noqa: A002 - the name in the file
    env_kwargs: dict[str, Any] | None = None,
    scenes: list[str] | None = None,
    n_scenes: int | None = None,
) -> Values:
    """Return the fields of trials in an environment; its sets of scenes are by default those shipped for it."""
    env_id = id or name
    kwargs = env_kwargs or {}
    check_env_kwargs(kwargs)
    task = registered_task(env_id, **kwargs)
    check_whole("n_scenes", 1 if n_scenes is None else n_scenes)
    places = []
    for each in MEASURED if scenes is None else scenes:
        if each in SETS:
            if each in SEEDS or shipped_set(each, task) is not None:  # the others cannot be drawn
                places.append(each)
        elif (folder / each).is_file():
            places.append(str((folder / each).absolute()))
        else:
            raise ValueError(f"{unknown_name('scenes', each, SETS)}; or the path of a file of scenes")
    if not places:
        raise ValueError(f"none of {', '.join(scenes or ())} is shipped for {env_id}")
    return {
        "environment": name,
        "env_id": env_id,
        "env_kwargs": kwargs,
        "scenes": tuple(places),
        "n_scenes": n_scenes,
    }


def _agent(
    env: Values,
    row: str,
    *,
    seeds: list[int],
    checks: list[int] | None = None,
    refine: list[int] | None = None,
    untrained: bool = False,
    **training: Any,
) -> list[Trial]:
    """Return a trial for each seed of an agent whose configuration is allowed in its environment."""
    numbers = tuple(check_whole("checks", number) for number in checks or [0])
    refined = tuple(check_whole("refine", number) for number in refine or [])
    if (any(numbers) or refined) and training.get("algo", "viaq") != "viaq":
        raise ValueError(f"checks and refine are for the proposals of viaq, got algo {training['algo']}")
    if refined and registered_task(env["env_id"], **env["env_kwargs"]).replanning:
        raise ValueError(f"refine is for tasks with one decision for a movement, {env['env_id']} has several")
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must hold at least one number and none twice, got {seeds}")
    trials = []
    for seed in seeds:
        trial = Trial(
            **env, row=row, seed=seed, training=training, checks=numbers, refine=refined, untrained=untrained
        )
        config = trial.config(Path())
        check_hyperparameters(config.algorithm, config.hyperparameters)
        trials.append(trial)
    return trials


def _baseline(env: Values, row: str, *, method: str = "") -> list[Trial]:
    """Return the trial of a baseline that exists in its environment."""
    factory(method or row, registered_task(env["env_id"], **env["env_kwargs"]))  # an unknown name is told now
    return [Trial(**env, row=row, method=method or row)]


def _search(
    env: Values,
    row: str,
    *,
    seeds: list[int],
    parameters: dict[str, Any],
    trials: int = 20,
    first: list[dict[str, Any]] | None = None,
    **training: Any,
) -> list[Search]:
    """Return a search whose values, or whose lowest and highest ones, are allowed."""
    (trial,) = _agent(env, row, seeds=seeds[:1], **training)
    if not parameters:
        raise ValueError("parameters must hold at least one list or range")
    if not trial.config(Path()).evaluation_interval:
        raise ValueError("eval_every must be 1 or more in a search, which compares success in validation")
    for path in itertools.chain(*(first or [])):
        if path not in parameters:
            raise ValueError(unknown_name("first", path, parameters))
    for path, values in parameters.items():
        for value in _ends(path, values):  # an impossible value is an error now, and not in the last trial
            _made("parameters", _agent, {"seeds": [0], **_with(training, {path: value})}, env, row)
    check_whole("trials", trials)
    return [
        Search(
            **env, row=row, seed=trial.seed, training=training, parameters=parameters, trials=trials,
            first=tuple(first or ()),
        )
    ]  # fmt: skip


def _ends(path: str, given: Any) -> list[Any]:
    """Return all values of a list, or the lowest and the highest of a range."""
    if isinstance(given, list) and given:
        return given
    ends = given if isinstance(given, Mapping) else {}
    low: Any = ends.get("low")
    high: Any = ends.get("high")
    if not (is_number(low) and is_number(high) and low < high) or (ends.get("log") and low <= 0):
        raise ValueError(
            f"{path} must be a list, or a range such as {{low: 1e-4, high: 1e-2, log: true}}, got {given!r}"
        )
    return [low, high]
