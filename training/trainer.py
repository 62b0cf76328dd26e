"""Training of an agent, from a configuration to a run folder, with validations, checkpoints and logs on the way."""

from __future__ import annotations

import dataclasses
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure

from viapoint.envs.registration import full_id
from viapoint.training.agents.model_io import build
from viapoint.training.configs import TrainConfig
from viapoint.training.evaluation import MethodResult, evaluate, one_thread
from viapoint.training.files import BadFileError, read_json, versions, write_json
from viapoint.training.report import progress_bar
from viapoint.training.runs import Run, check_unchanged, locked
from viapoint.training.scene_sets import FrozenScenes, scenes_for
from viapoint.training.vec_env import LOGGED, ViaVecEnv

Callbacks = BaseCallback | Sequence[BaseCallback] | None

# Form of the progress bar; narrow terminals cut its end, so success, the description, is first
PROGRESS = "{desc}{percentage:.0f}%|{bar}| {elapsed}<{remaining}, {n_fmt}/{total_fmt} decisions"
LOG_EVERY = 1_000  # Decisions between two entries of the log
RATES = ("collision", "reachable")  # Metrics that are true or false
# Metrics of a validation in the log and in the learning curve; medians in [m], [s], and [rad] for errors of joints
VALIDATED = ("success", "collision", "min_clearance", "goal_error", "jerk_ratio", "duration")


class TrainingStoppedError(Exception):
    """Training was stopped by Ctrl-C after its state was saved."""

    exit_code = 130  # Exit code of shells for Ctrl-C


class _TrainingEnds(Exception):  # noqa: N818 - it is no error
    """Training ends before its limit: success does not rise any more, or Ctrl-C or a callback asked for it."""


class TrainingFailedError(Exception):
    """Training could not continue, as a disk is full, for example; files saved before are intact."""


def train(config: TrainConfig, callback: Callbacks = None) -> Run:
    """Train an agent and write everything about the training to a run folder.

    With `config.resume` the run in the folder continues with its own configuration from its last checkpoint, to the
    same result as if it had never stopped; `n_timesteps` may extend it. A training that has ended because it stalled
    (`stop_when_stalled`) stays as it is: the decision to end depends on the learning curve alone.

    Args:
        config: Everything that a training depends on.
        callback: Callback of Stable-Baselines3, or a list of them. One that stops the training does so at the end of
            the round of experience and updates, from which the run can go on; checkpoints do not contain its state.

    Returns:
        The run. `run.best` and `run.final` are model folders, which :func:`evaluate` and :func:`load_agent` accept.

    Raises:
        BadFileError: The folder cannot hold the run, or does not hold the one to resume.
        ValueError: There is no such environment or model; the folder is left empty.
        TrainingStoppedError: Ctrl-C was pressed; a checkpoint and a model are saved.
        TrainingFailedError: A file could not be written.

    Example:
        >>> import tempfile
        >>> from viapoint.training import TrainConfig, train
        >>> config = TrainConfig(
        ...     env="viapoint/PlanarReach-v0", n_timesteps=64, eval_scenes=8, out=tempfile.mkdtemp(), progress=False
        ... )
        >>> run = train(config)
        >>> run.best.name, run.final.name
        ('best', 'final')
    """
    given = () if callback is None else callback
    callbacks = list(given) if isinstance(given, Sequence) else [given]
    if not all(isinstance(each, BaseCallback) for each in callbacks):
        raise ValueError(f"callback must be one of Stable-Baselines3, or a list of them, got {callback!r}")
    with one_thread():
        if config.resume:
            run = Run(config.folder)
            with locked(run.folder):
                _restore_settings(run, config)
                if config.progress:
                    print(f"going on with {run}", file=sys.stderr)
                with _untrained_model(run.config) as model:
                    _continue_training(run, model, callbacks)
            return run
        begun = config.resolved
        with _untrained_model(begun) as model:  # before there is a folder: what cannot be built leaves none
            run = Run.create(begun)
            _warn(begun)
            with locked(run.folder):
                _continue_training(run, model, callbacks)
        return run


def train_or_resume(config: TrainConfig, callback: Callbacks = None) -> Run:
    """Train, go on with a training of these settings that was interrupted, or return one that has ended."""
    begun = config.folder / "config.json"
    try:
        if not begun.is_file():
            return train(config, callback)
    except BadFileError:
        if not begun.is_file():
            raise
        # A worker of a study that was killed has begun it meanwhile; it ends soon.
    run = Run(config.folder)
    check_unchanged(run, dataclasses.replace(config, n_timesteps=run.config.total_timesteps).resolved)
    if run.ended and run.config.total_timesteps == config.total_timesteps:
        return run
    return train(dataclasses.replace(config, resume=True, n_timesteps=config.total_timesteps), callback)


def _warn(config: TrainConfig) -> None:
    """Print what a training of a resolved configuration can hardly learn."""
    starts = config.hyperparameters.get("learning_starts", 0)
    if config.total_timesteps <= starts:
        reason = f"learning starts after {starts} decisions (learning_starts)"
        told = f"n_timesteps={config.total_timesteps}: the network is not updated once, as {reason}"
        print(told, file=sys.stderr)
    if not config.task.n_via and config.task.n_obstacles[1] and not config.task.stepwise:
        print("n_via=0: all movements are straight, and none can pass around an obstacle", file=sys.stderr)


@contextmanager
def _untrained_model(config: TrainConfig) -> Iterator[BaseAlgorithm]:
    """Build the untrained model of a resolved configuration with its own environments, and close them at the end."""
    env = ViaVecEnv(config.env, config.n_envs or config.preset.n_envs, **config.env_kwargs)
    with closing(env):
        try:
            policy = config.preset.policy
            model = build(config.algorithm, policy, env, config.hyperparameters, seed=config.seed)
        except Exception as error:  # of a library, for networks or buffers that cannot be built
            usual = config.preset.hyperparameters
            others = {name: each for name, each in config.hyperparameters.items() if usual.get(name) != each}
            raise ValueError(f"no {config.algo} for {config.env} with {others}: {error}") from error
        yield model


def _continue_training(run: Run, model: BaseAlgorithm, callbacks: list[BaseCallback]) -> None:
    """Train from the last checkpoint of the run to its end."""
    try:
        seconds = run.restore(model)
        with (
            closing(configure(str(run.folder / "tensorboard"), ["tensorboard"])) as logger,
            RunCallback(run, callbacks, seconds, model.num_timesteps) as monitor,
        ):
            model.set_logger(logger)
            run.write_curve(monitor.curve)  # without validations after the checkpoint
            # All else stays as it was written: an arm is named by its file, also while its copy takes its place.
            path = run.folder / "config.json"
            write_json(path, {**read_json(path), "n_timesteps": run.config.total_timesteps})
            remaining = run.config.total_timesteps - model.num_timesteps
            if remaining > 0 and not run.stalled:
                _learn(model, remaining, monitor, fresh=seconds is None)
            run.save("final", model)
            if monitor.interrupted:  # also after the last decision
                told = f"stopped after {run.decisions} decisions, and all is saved"
                raise TrainingStoppedError(f"{told}; go on with: {_resume_command(run)}")
    except OSError as error:
        told = f"{error}; all up to decision {run.decisions} is saved; go on with: {_resume_command(run)}"
        raise TrainingFailedError(f"training cannot go on: {told}") from error


def _learn(model: BaseAlgorithm, steps: int, monitor: RunCallback, *, fresh: bool) -> None:
    """Learn; a training that stalls, or that is stopped, ends like any other."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "the network is not updated")  # `_warn` has told it
            model.learn(steps, monitor, None, reset_num_timesteps=fresh)  # type: ignore[arg-type]
    except _TrainingEnds:
        for each in monitor.callbacks:
            each.on_training_end()  # `learn` has not told them that it ends
        if hasattr(model, "calibrate"):  # nor has it done this at its end
            model.calibrate()


def _restore_settings(run: Run, config: TrainConfig) -> None:
    """Take over a run's own configuration, except for fields that may change."""
    check_unchanged(run, config, TrainConfig())
    begun = run.config.total_timesteps
    number = config.n_timesteps or begun
    if number < begun:  # settings change in the course of a run
        reason = f"holds a run of {begun} decisions; n_timesteps must be as many or more, got {number}"
        raise BadFileError(run.folder, reason)
    run.config = dataclasses.replace(run.config, n_timesteps=number, progress=config.progress)
    others = []
    for name, now in versions().items():
        began = run.versions.get(name, now)
        if began != now:
            others.append(f"{name} {began} (now {now})")
    if others:
        print(f"the run began with {', '.join(others)}: it may end otherwise", file=sys.stderr)


def _resume_command(run: Run) -> str:
    """Return the command that goes on with a run."""
    env = full_id(run.config.env)  # a run does not know the module that registers an id
    named = ["--env", env] if env != run.config.env else []
    return shlex.join(["viapoint", "train", "--resume", *named, "--out", str(run.folder)])


class RunCallback(CallbackList):
    """Callback that validates, keeps the best model, writes checkpoints and logs, and shows progress.

    It acts between two collections of experience, when the state of a run is complete. It draws no random numbers of
    the learner, so it does not change the result. Use it as a context around `learn`: inside, the first Ctrl-C saves
    and stops, the second stops at once.

    It calls the callbacks of the user, which stop a training between two collections only: in the middle of one,
    Stable-Baselines3 drops the step that it has just made, and no run could go on from there to the same result.
    """

    def __init__(self, run: Run, callbacks: Sequence[Any], seconds: float | None, decisions: int) -> None:
        super().__init__(list(callbacks))
        self.run, self.config = run, run.config
        earlier = [] if seconds is None else run.curve
        self.curve = [record for record in earlier if record["decisions"] <= decisions]
        self._began = time.monotonic() - (seconds or 0.0)  # without interruptions and validations
        self._before = decisions  # Decisions when it was last decided what is due
        self._validation: FrozenScenes | None = None
        if self.config.evaluation_interval:
            self._validation = scenes_for("validation", self.config.task, self.config.eval_scenes)
        self.interrupted = False  # True once Ctrl-C was pressed
        self.stopped = False  # True once a callback of the user has asked for the end of the training
        self._collected = False  # True once experience was collected, in this part of the run

    @property
    def seconds(self) -> float:
        """Wall time of training, with earlier parts of the run and without validation, [s]."""
        return time.monotonic() - self._began

    def __enter__(self) -> RunCallback:
        shown = {} if self.config.progress else {"disable": True}
        self._bar = progress_bar(total=self.config.total_timesteps, bar_format=PROGRESS, **shown)
        self._handler: Any = None
        with suppress(ValueError):  # other threads than the main one get no signals
            self._handler = signal.signal(signal.SIGINT, self._on_interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        if self._handler is not None:
            signal.signal(signal.SIGINT, self._handler)
        self._bar.close()

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # for the second Ctrl-C
        self.interrupted = True
        self._bar.write("saving and leaving; Ctrl-C again leaves at once", file=sys.stderr)

    def _on_step(self) -> bool:
        self._show_progress()
        self.stopped |= not super()._on_step()
        return True

    def _on_rollout_start(self) -> None:
        self._run_due_actions(final=self.stopped)
        if self.interrupted or self.stopped or self.run.stalled:
            self.run.checkpoint(self.model, self.seconds)
            raise _TrainingEnds
        if self.model.use_sde and self._collected:
            # This noise was drawn before the checkpoint. It is drawn anew, as it is when a run goes on from there.
            policy: Any = getattr(self.model, "actor", self.model.policy)
            policy.reset_noise(self.model.n_envs)
        self._collected = True
        super()._on_rollout_start()

    def _on_training_end(self) -> None:
        self._run_due_actions(final=True)
        super()._on_training_end()

    def _run_due_actions(self, *, final: bool) -> None:
        config = self.config
        due = final or not self.curve or self._is_due(config.evaluation_interval or 1)
        validates = self._validation is not None and due
        if validates:
            self._validate()
        if validates or final or self._is_due(LOG_EVERY):
            self._log()
        saves = final or self._is_due(config.checkpoint_every or config.preset.checkpoint_every)
        self._before = self.num_timesteps
        if saves:
            self.run.checkpoint(self.model, self.seconds)

    def _is_due(self, interval: int) -> bool:
        """Return whether decisions have passed a multiple of an interval."""
        return self.num_timesteps // interval > self._before // interval

    def _validate(self) -> None:
        """Evaluate the policy, extend the learning curve, and save the model if it is the best so far."""
        if self._validation is None or (self.curve and self.curve[-1]["decisions"] == self.num_timesteps):
            return
        began = time.monotonic()
        (result,) = evaluate(self.model, scenes=self._validation, time_decisions=False).results
        if result.partial:  # Ctrl-C has ended it: some scenes say nothing of all
            return
        record = self._record(result, began - self._began)
        self.curve.append(record)
        self.run.write_curve(self.curve)
        if self.config.progress and self._bar.disable:
            rate = 100.0 * record["success"]["rate"]
            more = ", as rounds are whole" if self.num_timesteps > self.config.total_timesteps else ""
            decisions = f"{self.num_timesteps} of {self.config.total_timesteps} decisions{more}"
            print(f"{decisions}: success {rate:.1f} % in validation", file=sys.stderr)
        # A validation is better with more success, then with less jerk.
        best = max(self.curve, key=lambda each: (each["success"]["rate"], -(each["jerk_ratio"] or 0.0)))
        if record is best:
            # Agents that predict their success are calibrated for a file alone: no plan depends on it.
            if self.num_timesteps and hasattr(self.model, "calibrate"):
                self.model.calibrate()
            self.run.save("best", self.model)
        self._show_progress()
        self._began += time.monotonic() - began  # the time of a validation does not count

    def _record(self, result: MethodResult, seconds: float) -> dict[str, Any]:
        """Return the record of a validation for the learning curve, and log it."""
        summary = result.summary()
        env = self.training_env
        assert isinstance(env, ViaVecEnv)
        record: dict[str, Any] = {"decisions": self.num_timesteps, "physics_steps": env.physics_steps}
        record |= {"seconds": round(seconds, 3), "success_by_band": summary["success_by_band"]}
        for name in VALIDATED:
            value = record[name] = summary[name]
            if isinstance(value, dict):
                self.logger.record(f"validation/{name}_rate", value["rate"])
            elif value is not None:  # the median of no values
                self.logger.record(f"validation/{name}", value)
        return record

    def _log(self) -> None:
        episodes = list(self.model.ep_info_buffer or ())
        for name in LOGGED:
            values = [episode[name] for episode in episodes if name in episode]
            if values:
                tag = f"rollout/{name}_rate" if name in RATES else f"rollout/{name}"
                self.logger.record(tag, float(np.mean(values)))
        self.model.dump_logs()

    def _show_progress(self) -> None:
        self._bar.update(min(self.num_timesteps, self.config.total_timesteps) - self._bar.n)
        shown = []
        if self.model.ep_success_buffer:
            shown.append(f"success {100.0 * np.mean(self.model.ep_success_buffer):.0f} %")
        if self.curve:
            shown.append(f"validation {100.0 * self.curve[-1]['success']['rate']:.1f} %")
        self._bar.set_description(", ".join(shown), refresh=False)
