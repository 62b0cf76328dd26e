"""Training of an agent, from a configuration to a run folder."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from viapoint.training.agents.model_io import build
from viapoint.training.config.configs import TrainConfig
from viapoint.training.evaluation.evaluator import one_thread
from viapoint.training.io.files import BadFileError, versions
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.callback import RunCallback, TrainingStalledError, resume_command
from viapoint.training.runs.run_dir import Run, check_free, check_unchanged, write_config

Callbacks = BaseCallback | Sequence[BaseCallback] | None

# Errors of libraries for networks or buffers that cannot be built
UNFIT = (
    ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError,
)  # fmt: skip


class TrainingFailedError(Exception):
    """Training could not continue, as a disk is full, for example; files saved before are intact."""


def train(config: TrainConfig, callback: Callbacks = None) -> Run:
    """Train an agent and write everything about the training to a run folder.

    With `config.resume` the run in the folder continues with its own configuration from its last checkpoint, to the
    same result as if it had never stopped; `n_timesteps` may extend it. A training that has ended because it stalled
    (`stop_when_stalled`) stays as it is: the decision to end depends on the learning curve alone.

    Args:
        config: Environment, algorithm, seed, run folder and everything else that a training depends on.
        callback: Callback of Stable-Baselines3, or a list of them. The checkpoints of a run do not contain their state.

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
        ...     env="viapoint/PlanarReach-v0",
        ...     n_timesteps=64,
        ...     n_envs=32,
        ...     eval_scenes=8,
        ...     out=tempfile.mkdtemp(),
        ...     progress=False,
        ... )
        >>> run = train(config)
        >>> run.best.name, run.final.name
        ('best', 'final')
    """
    with one_thread():
        if config.resume:
            run = Run(config.folder)
            with run.locked():
                _restore_settings(run, config)
                with _untrained_model(run.config) as model:
                    _continue_training(run, model, callback)
            return run
        check_free(config.folder)
        begun = resolved(config)
        _warn(begun)
        with _untrained_model(begun) as model:  # before there is a folder: what cannot be built leaves none
            run = Run.create(begun)
            with run.locked():
                _continue_training(run, model, callback)
        return run


def train_or_resume(config: TrainConfig, callback: Callbacks = None) -> Run:
    """Train, go on with a training of these settings that was interrupted, or return one that has ended.

    Raises:
        BadFileError: The folder holds a training with other settings, or something else.
        ValueError, TrainingStoppedError, TrainingFailedError: As for :func:`train`.
    """
    begun = config.folder / "config.json"
    if not begun.is_file():
        try:
            return train(config, callback)
        except BadFileError:
            if not begun.is_file():
                raise
            # A worker of a study that was killed has begun it meanwhile; it ends soon.
    run = Run(config.folder)
    check_unchanged(run, resolved(dataclasses.replace(config, n_timesteps=run.config.total_timesteps)))
    if run.ended and run.config.total_timesteps == config.total_timesteps:
        return run
    again = TrainConfig(
        out=config.folder, resume=True, progress=config.progress, n_timesteps=config.total_timesteps
    )
    return train(again, callback)


def resolved(config: TrainConfig) -> TrainConfig:
    """Return a configuration in which the values of the preset replace None, as a run stores it."""
    return dataclasses.replace(
        config,
        n_timesteps=config.total_timesteps,
        n_envs=config.n_envs or config.preset.n_envs,
        eval_every=config.evaluation_interval,
        checkpoint_every=config.checkpoint_every or config.preset.checkpoint_every,
        hyperparameters=config.all_hyperparameters,
    )


def _warn(config: TrainConfig) -> None:
    """Print what a training of a resolved configuration can hardly learn."""
    starts = config.hyperparameters.get("learning_starts", 0)
    if config.total_timesteps <= starts:
        print(
            f"n_timesteps={config.total_timesteps}: the network is not updated once, as learning starts after "
            f"{starts} decisions (learning_starts)",
            file=sys.stderr,
        )
    if not config.task.n_via and config.task.n_obstacles[1] and not config.task.stepwise:
        print("n_via=0: all movements are straight, and none can pass around an obstacle", file=sys.stderr)


@contextmanager
def _untrained_model(config: TrainConfig) -> Iterator[BaseAlgorithm]:
    """Build the untrained model of a resolved configuration with its own environments, and close them at the end."""
    try:
        env = ViaVecEnv(config.env, config.n_envs or config.preset.n_envs, **config.env_kwargs)
    except TypeError as error:
        raise ValueError(f"env_kwargs of {config.env}: {error}") from error
    with closing(env):
        try:
            model = build(
                config.algorithm, config.preset.policy, env, config.hyperparameters, seed=config.seed
            )
        except UNFIT as error:
            usual = config.preset.arguments()
            others = {name: each for name, each in config.hyperparameters.items() if usual.get(name) != each}
            raise ValueError(
                f"{config.algo} cannot be made for {config.env} with {others}: {error}"
            ) from error
        yield model


def _continue_training(run: Run, model: BaseAlgorithm, callback: Callbacks) -> None:
    """Train from the last checkpoint of the run to its end."""
    folder = str(run.folder / "tensorboard")
    given = [callback] if isinstance(callback, BaseCallback) else list(callback or ())
    try:
        with (
            closing(Logger(folder, [TensorBoardOutputFormat(folder)])) as logger,
            RunCallback(run) as monitor,
        ):
            model.set_logger(logger)
            restored = run.restore(model)
            if restored is not None:
                monitor.restore(float(restored["seconds"]), model.num_timesteps)
            run.write_curve(monitor.curve)  # without validations after the checkpoint
            remaining = run.config.total_timesteps - model.num_timesteps
            if remaining > 0 and not run.stalled:
                _learn(model, remaining, [monitor, *given], fresh=restored is None)
            run.save("final", model)
    except OSError as error:
        raise TrainingFailedError(
            f"training cannot go on: {error}; all up to decision {run.decisions} is saved; go on with: "
            f"{resume_command(run)}"
        ) from error


def _learn(model: BaseAlgorithm, steps: int, callbacks: list[BaseCallback], *, fresh: bool) -> None:
    """Learn; a training that stalls ends like any other."""
    try:
        model.learn(steps, callbacks, None, reset_num_timesteps=fresh)  # type: ignore[arg-type]
    except TrainingStalledError:
        for each in callbacks[1:]:
            each.on_training_end()


def _restore_settings(run: Run, config: TrainConfig) -> None:
    """Take over a run's own configuration, except for fields that may change."""
    check_unchanged(run, config, TrainConfig())
    if config.n_timesteps is not None and config.n_timesteps != run.config.total_timesteps:
        if config.n_timesteps < run.decisions:
            raise BadFileError(
                run.folder,
                f"holds a run of {run.decisions} decisions already; n_timesteps must be as many or more, "
                f"got {config.n_timesteps}",
            )
        run.config = dataclasses.replace(run.config, n_timesteps=config.n_timesteps)
        write_config(run.folder, run.config)
    run.config = dataclasses.replace(run.config, progress=config.progress)
    began = run.versions
    others = [
        f"{name} {began[name]} (now {now})" for name, now in versions().items() if began.get(name, now) != now
    ]
    if others:
        print(f"the run began with {', '.join(others)}: it may end otherwise", file=sys.stderr)
