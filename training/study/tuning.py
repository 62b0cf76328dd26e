"""Hyperparameter search with Optuna, which any number of processes and machines may share.

tuning.json       description of the search and version of the package
journal.log       trials: Optuna's journal, to which every process appends
trials/<number>/  run folders of each trial, one for each seed; trials/<number>.lock while a process works on it
report.md         table of trials, importance of parameters, counts of pruned trials
trials.json       all trials as plain values
best.json         configuration of the best trial, as TrainConfig.from_json reads it
curves.png        learning curves

A process takes a trial by locking its file. The operating system unlocks the file when the process ends, so another
process recognises an abandoned trial, marks it as failed and repeats it: its training goes on from its last checkpoint.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from filelock import FileLock, Timeout
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState
from stable_baselines3.common.callbacks import BaseCallback

from viapoint.training.config.configs import TrainConfig
from viapoint.training.io.files import BadFileError, read_json, write_json
from viapoint.training.io.installed import versions
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.run_dir import Run
from viapoint.training.runs.trainer import new_model, resolved, train
from viapoint.training.study.runners import Job, make_runner
from viapoint.training.study.search_space import ATTEMPTS, ERROR, SearchSpace, stored

SAVING_TIME = 60.0
"""Time that an abandoned training has to write its checkpoint and end, [s]."""
MOST_REPEATS = 3
"""Number of times that a trial is repeated whose process ends without a result."""


class TrialLock(NamedTuple):
    """Trial that this process works on, and the lock that says so."""

    trial: Trial
    lock: FileLock


class Tuning:
    """Hyperparameter search in a folder.

    Args:
        folder: Folder of an existing search.

    Raises:
        BadFileError: The folder holds no search, or one of another version of this package.

    Example:
        >>> import tempfile
        >>> from viapoint.training.study.search_space import SearchSpace
        >>> from viapoint.training.study.tuning import Tuning
        >>> search = SearchSpace(
        ...     env="viapoint/PlanarReach-v0",
        ...     algo="sac",
        ...     n_timesteps=64,
        ...     n_envs=32,
        ...     eval_scenes=8,
        ...     trials=2,
        ...     parameters={"learning_rate": {"type": "float", "low": 1e-4, "high": 1e-2, "log": True}},
        ... )
        >>> tuning = Tuning.create(tempfile.mkdtemp(), search)
        >>> tuning.work(workers=0)
        >>> [trial.state.name for trial in tuning.trials]
        ['COMPLETE', 'COMPLETE']
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not (self.folder / "tuning.json").is_file():
            raise BadFileError(self.folder, "holds no search: it has no tuning.json")
        record = read_json(self.folder / "tuning.json")
        mine, theirs = versions()["viapoint"], record.pop("viapoint", None)
        if theirs != mine:
            raise BadFileError(self.folder, f"holds a search by viapoint {theirs}; this is viapoint {mine}")
        self.search = SearchSpace.from_json(record)
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        storage = JournalStorage(JournalFileBackend(str(self.folder / "journal.log")))
        self.study = optuna.create_study(
            study_name="viapoint",
            storage=storage,
            direction="maximize",
            load_if_exists=True,
            pruner=self.search.make_pruner(),
        )

    @classmethod
    def create(cls, folder: str | Path, search: SearchSpace) -> Tuning:
        """Create the folder of a search, or join the search in it.

        Raises:
            BadFileError: The folder holds another search, or something else.
            ValueError: A model cannot be built with the lowest or highest values of the parameters.
        """
        folder = Path(folder)
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        if names - {"lock"} and "tuning.json" not in names:
            raise BadFileError(folder, "is not empty and holds no search; name another folder")
        if not names:
            check_models(search)
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / "lock"):
            begun = (folder / "tuning.json").is_file()
            if not begun:
                write_json(folder / "tuning.json", {**search.as_json(), "viapoint": versions()["viapoint"]})
            tuning = cls(folder)
            tuning._check_same(search)
            for given in () if begun else search.first:
                tuning.study.enqueue_trial({name: stored(value) for name, value in given.items()})
        return tuning

    def _check_same(self, search: SearchSpace) -> None:
        """Check that a search is the one in the folder, except for its number of trials."""
        begun, asked = (json.loads(json.dumps(each.as_json())) for each in (self.search, search))
        for name in begun:
            if name != "trials" and begun[name] != asked[name]:
                raise BadFileError(
                    self.folder,
                    f"holds a search with {name} = {json.dumps(begun[name])}, not {json.dumps(asked[name])}; name "
                    "another folder",
                )

    @property
    def trials(self) -> list[FrozenTrial]:
        """Trials that count: finished, pruned, running, waiting, and those that cannot be trained."""
        every = self.study.get_trials(deepcopy=False)
        return [each for each in every if each.state != TrialState.FAIL or ERROR in each.user_attrs]

    @property
    def finished(self) -> int:
        """Number of trials that are finished, pruned or cannot be trained."""
        return len([each for each in self.trials if each.state.is_finished()])

    @property
    def ranked(self) -> list[FrozenTrial]:
        """Finished trials, best first."""
        complete = [each for each in self.trials if each.state == TrialState.COMPLETE]
        return sorted(complete, key=lambda each: (-(each.value or 0.0), each.number))

    @property
    def best(self) -> FrozenTrial | None:
        """Finished trial with the highest score; None if there is none."""
        return next(iter(self.ranked), None)

    def folder_of(self, trial: Trial | FrozenTrial) -> str:
        """Return the folder of a trial below that of the search; a repeated trial has that of the first attempt."""
        first = [*trial.user_attrs.get(ATTEMPTS, ()), trial.number][0]
        return f"trials/{first:04d}"

    def work(
        self,
        trials: int | None = None,
        *,
        on: str = "local",
        workers: int | None = None,
        told: Callable[[str], None] = lambda line: None,
    ) -> None:
        """Train trials until the search has enough of them, counting those that other processes work on.

        Args:
            trials: Number of trials in total; that of the description if not given.
            on: Place of the trainings, see :func:`~viapoint.training.run_study`.
            workers: Number of trainings at the same time; 0 for one in this process.
            told: Function that shows one line for each finished trial.

        Raises:
            TuningStoppedError: A trial ended without a result, for example because the disk is full; the next call
                repeats it.
        """
        taken: dict[str, TrialLock] = {}
        try:
            with make_runner(on, self.folder, workers) as runner:
                for job, answer in runner.run(self._jobs(trials or self.search.trials, taken)):
                    if answer.error:
                        raise TuningStoppedError(f"{job.label} ended without a result: {answer.error}")
                    trial, lock = taken.pop(job.label)
                    told(self._tell(trial, answer.value))
                    lock.release()
        finally:
            for each in taken.values():
                each.lock.release()

    def _jobs(self, most: int, taken: dict[str, TrialLock]) -> Iterator[Job]:
        """Yield the jobs of further trials, and add the trials to `taken` by the labels of their jobs."""
        while True:
            with FileLock(self.folder / "lock"):
                each = self._next_trial(most)
            if each is None:
                return
            trial, folder = each.trial, self.folder_of(each.trial)
            label = f"trial {trial.number}"
            taken[label] = each
            known = self.study.get_trials(states=(TrialState.COMPLETE, TrialState.PRUNED))
            arguments = (folder, self.search.as_json(), trial.params, known)
            yield Job(label=label, function=train_trial, arguments=arguments, folder=folder)

    def _next_trial(self, most: int) -> TrialLock | None:
        """Return the next trial to train, or None if there are enough."""
        self._repeat_abandoned()
        counted = [each for each in self.trials if each.state != TrialState.WAITING]
        if len(counted) >= most:
            return None
        self.study.sampler = self.search.make_sampler(len(counted))
        trial = self.study.ask(self.search.distributions())
        lock = self._lock(trial.number)
        lock.acquire(timeout=0)
        return TrialLock(trial, lock)

    def _lock(self, number: int) -> FileLock:
        path = self.folder / "trials" / f"{number:04d}.lock"
        path.parent.mkdir(exist_ok=True)
        return FileLock(path)

    def _repeat_abandoned(self) -> None:
        """Mark running trials as failed whose process has ended, and queue them again."""
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            lock = self._lock(trial.number)
            try:
                lock.acquire(timeout=0)
            except Timeout:
                continue
            attempts = [*trial.user_attrs.get(ATTEMPTS, ()), trial.number]
            ends = len(attempts) > MOST_REPEATS
            if ends:
                reason = f"its process ended without a result {len(attempts)} times"
                Trial(self.study, trial._trial_id).set_user_attr(ERROR, reason)
            self.study.tell(trial.number, state=TrialState.FAIL)
            if not ends:
                again = optuna.create_trial(
                    state=TrialState.WAITING,
                    params=trial.params,
                    distributions=trial.distributions,
                    user_attrs={ATTEMPTS: attempts},
                )
                self.study.add_trial(again)
            lock.release()

    def _tell(self, trial: Trial, result: TrialResult) -> str:
        """Tell Optuna the result of a trial, and return a line about it."""
        for step, rate in result.reported.items():
            trial.report(rate, step)
            trial.should_prune()  # pruners note in the trial what they saw
        if result.error:
            trial.set_user_attr(ERROR, result.error)
            self.study.tell(trial, state=TrialState.FAIL)
            return f"trial {trial.number} cannot be trained: {result.error}"
        if result.pruned:
            told = self.study.tell(trial, state=TrialState.PRUNED)
            return f"trial {trial.number} pruned after {told.last_step} decisions"
        trial.set_user_attr("scores", result.scores)
        value = sum(result.scores) / len(result.scores)
        self.study.tell(trial, value)
        best = self.best
        leader = f"; best {100.0 * (best.value or 0.0):.1f} % of trial {best.number}" if best else ""
        return f"trial {trial.number}: {100.0 * value:.1f} %{leader}"


class TuningStoppedError(Exception):
    """Error of a search in which a trial ended without a result; finished trials are kept."""


class TrialResult(NamedTuple):
    """Result of the trainings of a trial."""

    scores: list[float]
    """Score of each seed."""
    reported: dict[int, float]
    """Success rate in validation of the first seed, by decisions."""
    pruned: bool = False
    error: str = ""
    """Reason why the trial cannot be trained."""


def train_trial(
    root: Path,
    folder: str,
    search: Mapping[str, Any],
    params: Mapping[str, Any],
    known: Sequence[FrozenTrial],
) -> TrialResult:
    """Train all seeds of a trial; an earlier attempt at it is continued.

    The pruner sees the trials that were finished when this one began, so it needs no connection to the others.

    Args:
        root: Folder of the search, or a copy of it.
        folder: Folder of the trial below it.
        search: Description of the search, as plain values.
        params: Parameters of the trial.
        known: Finished and pruned trials.

    Returns:
        The result. Checkpoints are removed when it is known; models and learning curves stay.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    space = SearchSpace.from_json(search)
    study = optuna.create_study(direction="maximize", pruner=space.make_pruner())
    study.add_trials(known)
    study.enqueue_trial(dict(params))
    trial = study.ask(space.distributions())
    watch = PruningCallback(trial, space, root / folder / f"seed-{space.seeds[0]}")
    scores: list[float] = []
    pruned, error = False, ""
    try:
        for seed in space.seeds:
            run = _train(
                space.training(params, seed, root / folder / f"seed-{seed}"), None if scores else watch
            )
            if not scores:
                watch.report(run.curve)
            scores.append(space.score(run.curve))
    except optuna.TrialPruned:
        pruned = True
    except BadFileError:
        raise
    except ValueError as refusal:
        error = " ".join(str(refusal).split())
    for checkpoints in (root / folder).glob("*/checkpoints"):
        shutil.rmtree(checkpoints, ignore_errors=True)
    return TrialResult(scores, study.get_trials()[-1].intermediate_values, pruned, error)


def _train(config: TrainConfig, callback: BaseCallback | None) -> Run:
    """Train, or continue what an earlier attempt began; a finished run is returned as it is."""
    if (config.folder / "final").is_dir():  # a training that was stopped has one, too
        run = Run(config.folder)
        if run.curve and run.curve[-1]["decisions"] >= config.total_timesteps:
            return run
    resume = (config.folder / "config.json").is_file()
    if resume:  # the process of the earlier attempt may still write its checkpoint
        with contextlib.suppress(Timeout), FileLock(config.folder / "lock", timeout=SAVING_TIME):
            pass
    return train(dataclasses.replace(config, resume=resume), callback)


class PruningCallback(BaseCallback):
    """Callback that reports the success rate of each validation to Optuna and ends trainings that the pruner rejects.

    Steps of the pruner are decisions, rounded down to a multiple of the interval between validations, because trials
    with other numbers of environments validate at other decisions. The validation before training does not count.
    """

    def __init__(self, trial: Trial, search: SearchSpace, folder: Path) -> None:
        super().__init__()
        self.trial, self.folder = trial, folder
        self.every = resolved(search.training(trial.params, 0)).evaluation_interval
        self.total = search.n_timesteps
        self._reported = 0
        self._steps: set[int] = set()

    def report(self, curve: list[dict[str, Any]]) -> None:
        """Report the validations of a learning curve that were not reported before."""
        for record in curve[self._reported :]:
            step = record["decisions"] // self.every * self.every
            step = record["decisions"] if step in self._steps else step  # the last one
            if step and step not in self._steps:
                self.trial.report(record["success"]["rate"], step)
                self._steps.add(step)
        self._reported = len(curve)

    def _on_rollout_start(self) -> None:
        curve = Run(self.folder).curve
        if len(curve) == self._reported:
            return
        self.report(curve)
        if self.num_timesteps < self.total and self.trial.should_prune():
            raise optuna.TrialPruned

    def _on_step(self) -> bool:
        return True


def check_models(search: SearchSpace) -> None:
    """Check that models can be built with the lowest and highest values of all parameters and with every choice."""
    for values in search.extremes():
        config = resolved(search.training(values, search.seeds[0]))
        try:
            opened = ViaVecEnv(config.env, 1, **config.env_kwargs)
        except TypeError as error:
            raise ValueError(f"env_kwargs of {config.env}: {error}") from None
        with contextlib.closing(opened) as env:
            try:
                new_model(config, env)
            except Exception as error:
                shown = ", ".join(f"{name}={value}" for name, value in values.items())
                raise ValueError(f"{config.algo} cannot be made with {shown}: {error}") from None
