"""Studies: many trainings, baselines and searches for hyperparameters from one file.

A study is described in YAML. Everything is checked when the file is read, so that a mistake in its last line is an
error before the first training; docs/studies.md explains the fields. Ray runs the trials, Optuna searches for
hyperparameters, and tables are written when all is done.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import itertools
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
from stable_baselines3.common.callbacks import ConvertCallback

from viapoint.envs.common.validation import is_number
from viapoint.envs.task import Task
from viapoint.training import files
from viapoint.training.agents.model_io import check_arguments, check_hyperparameters, load_model, untrained
from viapoint.training.checks import check_env_kwargs, check_folder, check_whole, named_path, unknown_name
from viapoint.training.configs import Algorithm, StudyConfig, TrainConfig
from viapoint.training.evaluation import across_seeds, evaluate_methods, wilson
from viapoint.training.extras import explain_import_error
from viapoint.training.planning.baselines import Method, agent_method, factory, make_method
from viapoint.training.planning.search import registered_task
from viapoint.training.plots import success_of_rows
from viapoint.training.rollout import whole_task
from viapoint.training.scene_sets import SEEDS, SETS, FrozenScenes, scenes_for, shipped_set
from viapoint.training.trainer import train_or_resume

Values = Mapping[str, Any]
Record = dict[str, Any]
# Types of the fields of a file
Entries = list[Any] | dict[str, dict[str, Any] | None]  # Names, or options by name
Names = list[str] | tuple[str, ...]
Numbers = list[int] | tuple[int, ...]
# Fields of a training that an agent may set
TRAINING_FIELDS = {each.name for each in dataclasses.fields(TrainConfig)}
TRAINING_FIELDS -= {"env", "arm", "seed", "out", "resume", "progress"}  # the arm is that of the scenes
MEASURED = ("test", "hard", "uniform")  # Sets by default; models are selected on `validation`

RETRIES = 2  # Number of times that a trial whose worker died is begun again
# Environment variables of Ray, which reads them when it is imported
SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # Ray sends nothing to its authors
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # otherwise it takes another address than 127.0.0.1
    "RAY_AIR_NEW_OUTPUT": "0",  # Ray Tune's own tables
    "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
    "TUNE_GLOBAL_CHECKPOINT_S": "5",  # a killed search loses at most its last seconds
}
KEYS = ["environment", "set", "method"]
# Columns that are medians over seeds; `decisions` are those of a training
MEDIANS = ["collision", "jerk_ratio", "movement_s", "decision_ms", "decisions"]
COLUMNS = [*KEYS, "seeds", "scenes", "success", "low", "high", *MEDIANS]  # Of `results.csv`
NOTE = (
    "Success with 95 % intervals. Jerk of successes, relative to the straight movement's. Median time of a decision on "
    "the cores of one trial. Written by `viapoint study`."
)
Told = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One row of the results for one seed: what a worker trains and measures; or a search for its hyperparameters."""

    environment: str  # Name of the environment in folders and tables
    env_id: str  # Id of the registered environment
    env_kwargs: Values  # Arguments of the environment
    scenes: tuple[str, ...] = ()  # Names of the measured sets, or files of scenes
    n_scenes: int | None  # Number of scenes of each set, evenly spread over it; None for all
    row: str = ""  # Name of the row, which is also that of its folder
    seed: int = 0
    training: Values = field(default_factory=dict)  # Fields of TrainConfig; empty for a baseline
    checks: tuple[int, ...] = (0,)  # Numbers of proposals that the agent checks, a row each
    refine: tuple[int, ...] = ()  # Numbers of proposals that the planner refines, a row each
    untrained: bool = False  # True to measure the network before training, too
    method: str = ""  # Name of a baseline; empty for an agent
    parameters: Values = field(default_factory=dict)  # Of a search: ranges or values by the path of a field
    trials: int = 0  # Of a search
    first: tuple[Values, ...] = ()  # Parameters of the first trials of a search

    @property
    def task(self) -> Task:
        """Task of the environment."""
        return registered_task(self.env_id, **self.env_kwargs)

    def folder(self, out: Path) -> Path:
        """Return the folder of the trial, or of the search."""
        row = out / files.folder_name(self.environment) / self.row
        return row if self.parameters else row / f"seed-{self.seed}"

    def config(self, folder: Path, values: Values | None = None) -> TrainConfig:
        """Return the configuration of a training in a folder, in a search with values of the parameters.

        Its `policy_kwargs` are merged with those of the preset.
        """
        given = _with(self.training, values or {})
        given["env_kwargs"] = {**self.env_kwargs, **given.get("env_kwargs", {})}
        config = TrainConfig(env=self.env_id, seed=self.seed, out=folder, progress=False, **given)
        own = config.hyperparameters.get("policy_kwargs")
        if own is None:
            return config
        usual = config.preset.hyperparameters.get("policy_kwargs", {})
        hyperparameters = {**config.hyperparameters, "policy_kwargs": {**usual, **own}}
        return dataclasses.replace(config, hyperparameters=hyperparameters)


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
    searches: tuple[Trial, ...]

    @classmethod
    def from_yaml(cls, path: str | Path) -> Study:
        """Read a study from a YAML file.

        Raises:
            ValueError: The file cannot be read, or something in it is not allowed; the message says what is.
        """
        path = Path(path).expanduser()
        content = files.read_bytes(path, files.LARGEST_JSON)
        try:
            return cls.from_dict(files.parse_yaml(content), name=path.stem, folder=path.parent)
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
    """Call `make` with fields of a file; errors begin with `where`, the place in the file."""
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
    environments: Entries | None = None,
    out: str = "",
    seeds: Numbers = (0,),
    agents: Entries | None = None,
    baselines: Entries | None = None,
    searches: Entries | None = None,
    scenes: Names = MEASURED,
    n_scenes: int | None = None,
) -> Study:
    """Return a study; the fields are those of the file."""
    known = {}
    used = ["tune", "study.json", "results.csv", "results.md"]  # Names in the folder of the study
    for env, fields in _entries(environments or {}):
        fields = {"scenes": scenes, "n_scenes": n_scenes, **fields}
        if files.folder_name(env) in used:
            raise ValueError(
                f"environments.{env}: there is {files.folder_name(env)!r} already; give another name"
            )
        used.append(files.folder_name(env))
        known[env] = _made(f"environments.{env}", _environment, fields, env, folder)
    found: list[Trial] = []
    rows: set[str] = set()
    for make, given in ((_agent, agents), (_baseline, baselines), (_search, searches)):
        for row, fields in _entries(given or {}):
            if row in rows:
                raise ValueError(f"rows must have different names, {row} is there twice")
            rows.add(row)  # rows are folders, which must not be shared
            for env in fields.pop("environments", known):
                if env not in known:
                    raise ValueError(unknown_name(f"{row}: environments", env, known))
                shared = {} if make is _baseline else {"seeds": seeds}
                found += _made(row, make, {**shared, **fields}, known[env], row)
    if not found:
        raise ValueError("there is nothing to do: give environments, and agents, baselines or searches")
    found.sort(key=lambda trial: trial.seed)
    return Study(
        name=name,
        out=Path(out or f"runs/{name}").expanduser(),
        trials=tuple(each for each in found if not each.parameters),
        searches=tuple(each for each in found if each.parameters),
    )


def _entries(given: Entries) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield name and fields of each entry of a list or mapping, one for each point of its grid."""
    if not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"a list is one of names; options are by name, NAME: {{id: ..., ...}}, got {given!r}"
        )
    entries = given if isinstance(given, dict) else dict.fromkeys(given)
    for name, fields in entries.items():
        if not name.strip("/. ") or ".." in name or name.startswith("/"):
            raise ValueError(f"names must be words, got {name!r}")
        rest = dict(fields or {})
        grid = rest.pop("grid", {})
        if not isinstance(grid, Mapping) or not all(isinstance(values, list) for values in grid.values()):
            raise ValueError(f"grid of {name} must be lists by the path of a field, got {grid!r}")
        for values in itertools.product(*grid.values()):
            point = dict(zip(grid, values, strict=True))
            ends = [f"-{path.rpartition('.')[2]}={value}" for path, value in point.items()]
            yield f"{name}{''.join(ends)}", _with(rest, point)


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
    scenes: Names,
    n_scenes: int | None,
) -> Trial:
    """Return the trial of no row in an environment, which leaves out sets of scenes that it lacks."""
    env = Trial(environment=name, env_id=id or name, env_kwargs=env_kwargs or {}, n_scenes=n_scenes)
    check_env_kwargs(env.env_kwargs)
    task = env.task
    if n_scenes is not None:
        check_whole("n_scenes", n_scenes)
    places = []
    for each in scenes:
        if each in SETS:
            if each in SEEDS or shipped_set(each, task) is not None:  # the others cannot be drawn
                places.append(each)
        elif (folder / each).is_file():
            places.append(str((folder / each).absolute()))
        else:
            raise ValueError(f"{unknown_name('scenes', each, SETS)}; or the path of a file of scenes")
    if not places:
        raise ValueError(f"none of {', '.join(scenes)} is shipped for {env.env_id}")
    names = [Path(each).stem for each in places]
    if len(set(names)) < len(names):
        raise ValueError(f"scenes must have different names, got {', '.join(names)}")
    return dataclasses.replace(env, scenes=tuple(places))


def _agent(
    env: Trial,
    row: str,
    *,
    seeds: Numbers,
    checks: Numbers = (0,),
    refine: Numbers = (),
    untrained: bool = False,
    **training: Any,
) -> list[Trial]:
    """Return a trial for each seed of an agent whose configuration is allowed in its environment.

    A row that begins with the name of an algorithm, such as `sac` or `sac-large`, is of this algorithm.
    """
    word = row.partition("-")[0]
    if word in get_args(Algorithm) and training.setdefault("algo", word) != word:
        raise ValueError(f"a row of this name is trained with {word}, got algo {training['algo']}")
    for name, numbers in (("checks", checks), ("refine", refine)):
        for number in numbers:
            check_whole(name, number)
    if refine and env.task.replanning:
        raise ValueError(f"refine is for tasks with one decision for a movement, {env.env_id} has several")
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must hold at least one number and none twice, got {seeds}")
    decides: Values = {"checks": tuple(checks) or (0,), "refine": tuple(refine), "untrained": untrained}
    agent = dataclasses.replace(env, row=row, training=training, **decides)
    trials = [dataclasses.replace(agent, seed=seed) for seed in seeds]
    for trial in trials:
        config = trial.config(Path())
        check_hyperparameters(config.algorithm, config.hyperparameters)
        if (any(checks) or refine) and config.algorithm != "viaq":
            raise ValueError(f"checks and refine are for the proposals of viaq, got algo {config.algorithm}")
    return trials


def _baseline(env: Trial, row: str, *, method: str = "") -> list[Trial]:
    """Return the trial of a baseline that exists in its environment."""
    factory(method or row, env.task)  # an unknown name is told now
    return [dataclasses.replace(env, row=row, method=method or row)]


def _search(
    env: Trial,
    row: str,
    *,
    seeds: Numbers,
    parameters: dict[str, Any],
    trials: int = 20,
    first: list[dict[str, Any]] | tuple[()] = (),
    **training: Any,
) -> list[Trial]:
    """Return a search whose values, or whose lowest and highest ones, are allowed."""
    (trial,) = _agent(env, row, seeds=seeds[:1], **training)
    if not parameters:
        raise ValueError("parameters must hold at least one list or range")
    if not trial.config(Path()).evaluation_interval:
        raise ValueError("eval_every must be 1 or more in a search, which compares success in validation")
    for path in itertools.chain(*first):
        if path not in parameters:
            raise ValueError(unknown_name("first", path, parameters))
    for path, values in parameters.items():
        for value in _ends(path, values):  # an impossible value is an error now, and not in the last trial
            _made("parameters", _agent, {"seeds": [0], **_with(training, {path: value})}, env, row)
    check_whole("trials", trials)
    return [dataclasses.replace(trial, parameters=parameters, trials=trials, first=tuple(first))]


def _ends(path: str, given: Any) -> list[Any]:
    """Return all values of a list, or the lowest and the highest of a range."""
    if isinstance(given, list) and given:
        return given
    ends: Any = given if isinstance(given, Mapping) else {}
    low, high = ends.get("low"), ends.get("high")
    ordered = is_number(low) and is_number(high) and low < high and not (ends.get("log") and low <= 0)
    if not ordered or set(ends) - {"low", "high", "log"}:
        example = "{low: 1e-4, high: 1e-2, log: true}"
        raise ValueError(f"{path} must be a list, or a range such as {example}, got {given!r}")
    return [low, high]


class StudyFailedError(Exception):
    """Error of a study in which some trials failed; the others are complete."""


def run(config: StudyConfig) -> None:
    """Run a study from its file, and print where its tables are."""
    study = Study.from_yaml(config.file)
    table = run_study(study, out=config.out, workers=config.workers, told=print)
    if len(table):
        print(_page(table, study.name))
    print(f"tables and figures: {config.out or study.out}")


def run_study(
    study: Study, *, out: str | Path | None = None, workers: int | None = None, told: Told = lambda line: None
) -> pd.DataFrame:
    """Run what a study has not run yet, and write its tables.

    Ray places the trials: the one that the process is connected to, or one of this machine. The same call continues a
    study that was stopped or killed.

    Args:
        study: Environments, agents, baselines and searches.
        out: Folder of runs and results; that of the study if not given.
        workers: Number of trials at the same time on this machine; as many as the cores allow if not given.
        told: Function of one line for each trial that ends.

    Returns:
        Table with one line for each environment, set of scenes and row, as in `results.csv`.

    Raises:
        ImportError: Ray, or for a search Optuna, is not installed.
        ValueError: A trial cannot be made, or the folder holds something else.
        StudyFailedError: Some trials failed.

    Example:
        >>> import tempfile
        >>> from viapoint.training import Study, run_study
        >>> given = {"environments": ["viapoint/PlanarReach-v0"], "baselines": ["straight"], "n_scenes": 20}
        >>> table = run_study(Study.from_dict({**given, "scenes": ["test"], "out": tempfile.mkdtemp()}), workers=1)
        >>> table.success.tolist()
        [1.0]
    """
    folder = named_path("out", study.out if out is None else out).absolute()
    check_folder(f"out {folder}", folder)
    mark = folder / "study.json"
    if not mark.is_file() or files.read_json(mark).get("viapoint") != "study":
        if folder.exists() and any(folder.iterdir()):
            raise files.BadFileError(folder, "holds something else than a study; name another folder")
        files.write_json(mark, {"viapoint": "study", "name": study.name})
    missing = [trial for trial in study.trials if not _finished_record(trial, folder)]
    searches = [search for search in study.searches if not _finished_record(search, folder)]
    failed = []
    if missing or searches:
        told(
            f"to do: {len(missing)} trials and {len(searches)} searches; the same command goes on after Ctrl-C"
        )
        with _connected(workers):
            failed += _run_trials(missing, folder, told)
            for search in searches:
                failed += _run_search(search, folder, workers, told)
    table = _write_results(study, folder)
    if failed:
        reasons = "; ".join(failed)
        raise StudyFailedError(f"{len(failed)} trials failed; the same command tries them again: {reasons}")
    return table


def _run_trial(trial: Trial, out: Path) -> Record:
    """Train if needed, or go on with an interrupted training, measure, and return the record of a trial."""
    record: Record = {"viapoint": "study", "asked": _asked(trial), "rows": []}
    env_kwargs = dict(trial.env_kwargs)
    methods: dict[str, Method] = {}
    if trial.method:
        methods[trial.row] = make_method(trial.method, trial.env_id, **env_kwargs, threads=1)
    else:
        config = trial.config(trial.folder(out))
        run = train_or_resume(config)
        models = {trial.row: load_model(run.best)}
        if trial.untrained:
            models[f"{trial.row}/untrained"] = untrained(models[trial.row], trial.seed)
        for name, model in models.items():
            for checks in trial.checks:
                methods[f"{name}/{checks}" if checks else name] = agent_method("agent", model, checks)
            for refine in trial.refine:
                methods[f"{name}/refine{refine}"] = agent_method("agent", model, 0, refine)
        env_kwargs = whole_task(config.env, config.env_kwargs)
        record["curve"] = [[each["decisions"], each["success"]["rate"]] for each in run.curve]
    env_kwargs["threads"] = 1  # other trials have the other cores
    for row, method in methods.items():
        for name, frozen in _sets(trial).items():
            line = {"method": row, "set": name, **_measured(method, frozen, trial.env_id, env_kwargs)}
            if not trial.method:
                line["decisions"] = 0 if "/untrained" in row else run.decisions
            record["rows"].append(line)
    files.write_json(trial.folder(out) / "result.json", record)
    return record


def _finished_record(trial: Trial, out: Path) -> Record:
    """Return the record of a trial or search that is complete, otherwise {}; that of other settings is obsolete."""
    path = trial.folder(out) / ("best.json" if trial.parameters else "result.json")
    record = files.read_json(path) if path.is_file() else {}
    return record if record.get("asked") == _asked(trial) else {}


def _write_results(study: Study, folder: Path) -> pd.DataFrame:
    """Write `results.csv`, `results.md` and a figure for each environment from all records, and return the table."""
    lines = []
    curves: dict[str, dict[str, list[Any]]] = {}
    for trial in study.trials:
        record = _finished_record(trial, folder)
        lines += [{"environment": trial.environment, **line} for line in record.get("rows", [])]
        if "curve" in record:
            of_rows = curves.setdefault(trial.environment, {})
            of_rows.setdefault(trial.row, []).append(record["curve"])
    table = _table(lines)
    files.write_bytes(folder / "results.csv", table.to_csv(index=False).encode())
    files.write_bytes(folder / "results.md", _page(table, study.name).encode())
    for environment, part in table.groupby("environment", sort=False):
        figure = folder / f"{files.folder_name(environment)}.png"
        success_of_rows(figure, part, curves.get(environment, {}))
    return table


def _table(lines: list[Record]) -> pd.DataFrame:
    """Return one line for each environment, set of scenes and row, over all its seeds."""
    rows = []
    for keys, runs in pd.DataFrame(lines, columns=[*COLUMNS, "solved", "band"]).groupby(KEYS, sort=False):
        solved = np.array([list(each) for each in runs["solved"]]) == "1"
        if len(runs) == 1:
            success, low, high = wilson(int(solved.sum()), solved.size)
        else:
            success, low, high = across_seeds(solved, runs["band"].iloc[0], np.random.default_rng(0))
        row = dict(zip(KEYS, keys, strict=True))
        row |= {"seeds": len(runs), "scenes": solved.shape[1], "success": success, "low": low, "high": high}
        rows.append({**row, **runs[MEDIANS].astype(float).median()})
    return pd.DataFrame(rows, columns=COLUMNS).round(4)


def _page(table: pd.DataFrame, title: str) -> str:
    """Return a page with one table for each environment: sets of scenes side by side, success in percent."""
    parts = [f"# {title}", NOTE]
    for environment, lines in table.groupby("environment", sort=False):
        rows = lines.drop_duplicates("method").set_index("method")
        shown = rows[["seeds"]].copy()
        for name, some in lines.groupby("set", sort=False):
            percent = (100.0 * some.set_index("method")[["success", "low", "high"]]).map("{:.1f}".format)
            shown[name] = percent["success"] + " % (" + percent["low"] + "-" + percent["high"] + ")"
        shown["jerk"] = rows["jerk_ratio"].map("{:.2f}".format, na_action="ignore")
        shown["decision ms"] = rows["decision_ms"].map("{:.1f}".format, na_action="ignore")
        text = shown.fillna("-").reset_index().to_markdown(index=False, disable_numparse=True)
        parts += [f"## {environment}", text]
    return "\n\n".join(parts) + "\n"


def _asked(trial: Trial) -> Record:
    """Return what identifies a trial as plain values."""
    plain: Record = files.as_plain(trial)
    plain["scenes"] = {name: frozen.sha256 for name, frozen in _sets(trial).items()}
    return plain


def _sets(trial: Trial) -> dict[str, FrozenScenes]:
    """Return the sets of scenes of a trial by name."""
    return {Path(name).stem: scenes_for(name, trial.task, trial.n_scenes) for name in trial.scenes}


def _measured(method: Method, frozen: FrozenScenes, env_id: str, env_kwargs: Record) -> Record:
    """Return what a line of a table says about a method in a set of scenes."""
    (result,) = evaluate_methods([method], frozen, env_id, env_kwargs=env_kwargs).results
    if result.partial:
        raise KeyboardInterrupt
    summary = result.summary()
    seconds = summary["decision_time"]
    return {
        "band": result.band.tolist(),
        "solved": "".join("01"[solved] for solved in result.success.astype(int)),
        "collision": summary["collision"]["rate"],
        "jerk_ratio": summary["jerk_ratio"],
        "movement_s": summary["duration"],
        "decision_ms": None if seconds is None else 1e3 * seconds,
    }


def _connected(workers: int | None) -> Any:
    """Return a context with a Ray of this machine that listens on 127.0.0.1 alone; nothing where there is a Ray.

    Ray Tune and Optuna take seconds to import, which is done only when a study runs.
    """
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    try:
        import optuna
        import ray.tune
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(explain_import_error(error, "a study"), name=error.name) from None
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if ray.is_initialized():
        return nullcontext()
    quiet: Values = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR"}
    return ray.init(address="local", num_cpus=workers, _node_ip_address="127.0.0.1", **quiet)


def _run_trials(trials: list[Trial], folder: Path, told: Told) -> list[str]:
    """Run trials as tasks of Ray, and return a line for each that failed."""
    import ray

    task = ray.remote(num_cpus=1, max_retries=RETRIES)(_run_trial)  # each trial computes on one core
    running: dict[Any, Trial] = {task.remote(trial, folder): trial for trial in trials}
    failed = []
    while running:
        (done,), _ = ray.wait(list(running))
        label = running.pop(done).folder(Path()).as_posix()
        try:
            first = ray.get(done)["rows"][0]
            rate = 100.0 * first["solved"].count("1") / len(first["solved"])
            told(f"{label}: {rate:.1f} % of {first['set']}")
        except Exception as error:
            failed.append(f"{label}: {_one_line(getattr(error, 'cause', error))}")
            told(f"{label} failed")
    return failed


def _run_search(search: Trial, folder: Path, workers: int | None, told: Told) -> list[str]:
    """Search for hyperparameters, write the best ones, and return a line for each trial if all of them failed.

    Optuna chooses the parameters, and successive halving (ASHA) stops trainings that are behind in validation.
    """
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler
    from ray.tune.search.optuna import OptunaSearch

    total = search.config(folder).total_timesteps

    def work(config: Values) -> None:
        reported = 1  # the validation before training says nothing about it

        def report(given: Values, _: object) -> bool:
            nonlocal reported
            for each in given["callback"].curve[reported:]:  # of the callback that validates
                tune.report({"success": each["success"]["rate"], "decisions": each["decisions"]})
                reported += 1
            return True

        try:
            settings = search.config(Path(tune.get_context().get_trial_dir()) / "run", config)
            run = train_or_resume(settings, ConvertCallback(report))
            tune.report({"success": run.curve[-1]["success"]["rate"], "decisions": run.decisions})
        except Exception as error:  # settings that cannot be trained do not end a search
            tune.report({"success": 0.0, "decisions": total, "error": _one_line(error)})

    described = json.dumps(dataclasses.asdict(search), sort_keys=True).encode()
    path = folder / "tune" / f"search-{search.row}-{hashlib.sha256(described).hexdigest()[:10]}"
    if tune.Tuner.can_restore(path):
        tuner = tune.Tuner.restore(str(path), work, resume_unfinished=True, restart_errored=True)
    else:
        space = {name: _distribution(given) for name, given in search.parameters.items()}
        first = [dict(each) for each in search.first] or None
        goal: dict[str, Any] = {"metric": "success", "mode": "max"}
        chooses = OptunaSearch(space, points_to_evaluate=first, seed=0, **goal)
        # Trainings end by themselves, before max_t.
        stops = ASHAScheduler("decisions", max_t=2 * total, grace_period=max(total // 4, 1))
        numbers: Any = {"num_samples": search.trials, "max_concurrent_trials": workers}
        how = tune.TuneConfig(**goal, **numbers, search_alg=chooses, scheduler=stops)
        again = tune.FailureConfig(max_failures=RETRIES)
        where = tune.RunConfig(name=path.name, storage_path=str(path.parent), failure_config=again, verbose=0)
        tuner = tune.Tuner(work, tune_config=how, run_config=where)
    handler = signal.getsignal(signal.SIGINT)
    results: Any = tuner.fit()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)  # Ray Tune leaves its own
    if sum(each.error is not None or each.metrics.get("done", False) for each in results) < search.trials:
        raise KeyboardInterrupt  # after Ctrl-C, Ray Tune returns
    failed = [_one_line(error) for error in results.errors]
    failed += [each.metrics["error"] for each in results if each.error is None and "error" in each.metrics]
    if len(failed) < search.trials:
        told(_write_search(search, results, folder))
        return []
    return [f"{search.row}: {reason}" for reason in failed]


def _distribution(given: Any) -> Any:
    """Return the distribution of a parameter: one of a list, or a range of whole numbers or of real ones."""
    from optuna import distributions

    if isinstance(given, list):
        return distributions.CategoricalDistribution(given)
    if isinstance(given["low"], int) and isinstance(given["high"], int):
        return distributions.IntDistribution(**given)
    return distributions.FloatDistribution(**given)


def _write_search(search: Trial, results: Any, folder: Path) -> str:
    """Write all trials of a search as CSV and the best one as JSON, and return a line about it."""
    lines = [{**each.config, **each.metrics} for each in results if each.error is None]
    table = pd.DataFrame(lines)[[*search.parameters, "success", "decisions"]]
    # A training that was stopped early had less success than others with as many decisions.
    table = table.sort_values(["decisions", "success"], ascending=False)
    files.write_bytes(search.folder(folder) / "trials.csv", table.to_csv(index=False).encode())
    best = table.to_dict("records")[0]
    chosen = search.config(folder, {path: best[path] for path in search.parameters})
    config = dataclasses.replace(chosen, out=None)
    record = {"viapoint": "search", "success": best["success"], "command": config.command}
    record |= {"asked": _asked(search), "training": files.as_plain(config)}
    files.write_json(search.folder(folder) / "best.json", record)
    return f"best of {search.row}, {100.0 * best['success']:.1f} %: {config.command}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
