"""Training an agent, from a configuration to a run folder."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from viapoint.training.config import TrainConfig
from viapoint.training.model_files import build
from viapoint.training.monitor import Monitor, TrainingStoppedError
from viapoint.training.runs import Run, versions
from viapoint.training.timed_buffers import TellElapsed
from viapoint.training.vec_env import ViaVecEnv

__all__ = ["TrainingFailedError", "TrainingStoppedError", "new_model", "one_thread", "resolved", "train"]


class TrainingFailedError(Exception):
    """Training could not go on, for example for want of disk space; what was saved before is whole."""


def train(config: TrainConfig) -> Run:
    """Train an agent and leave everything in a run folder.

    With `config.resume` the run in the folder goes on with its own configuration, from its last checkpoint,
    to the same result as if it had never stopped; `n_timesteps` may extend it.

    Raises:
        BadFileError: The folder cannot take the run, or does not hold the one to resume.
        TrainingStoppedError: Ctrl-C; a checkpoint and a model are saved.
        TrainingFailedError: A file could not be written.
    """
    run = Run(config.folder) if config.resume else Run.create(resolved(config))
    with run.locked(), one_thread():
        if config.resume:
            _take_up(run, config)
        env = ViaVecEnv(run.config.env, run.config.copies, **run.config.env_kwargs)
        try:
            model = new_model(run.config, env)
            with _logging(model, run), Monitor(run) as monitor:
                _learn(model, run, monitor)
        except OSError as error:
            raise TrainingFailedError(
                f"training cannot go on: {error}; {run.folder} keeps what was saved up to decision "
                f"{run.decisions}, and viapoint train --resume goes on from there"
            ) from error
        finally:
            env.close()
    return run


def resolved(config: TrainConfig) -> TrainConfig:
    """A configuration with everything that it left to the preset written out, as a run keeps it."""
    return dataclasses.replace(
        config,
        n_timesteps=config.total_timesteps,
        n_envs=config.copies,
        eval_every=config.evaluation_interval,
        checkpoint_every=config.checkpoint_interval,
        discount_unit=config.time_unit,
        hyperparameters={**config.preset.arguments(), **config.hyperparameters},
    )


def new_model(config: TrainConfig, env: ViaVecEnv) -> BaseAlgorithm:
    """The untrained model that a resolved configuration asks for."""
    return build(
        config.algo,
        config.preset.policy,
        env,
        config.hyperparameters,
        discount_unit=config.discount_unit,
        seed=config.seed,
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: fastest for small networks, and the same numbers on any number of cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _take_up(run: Run, config: TrainConfig) -> None:
    """Go on with a run's own configuration but for what this call may change."""
    if config.n_timesteps is not None and config.n_timesteps != run.config.total_timesteps:
        run.config = dataclasses.replace(run.config, n_timesteps=config.n_timesteps)
        run.write_config()
    run.config = dataclasses.replace(run.config, progress=config.progress)
    began, now = run.versions, versions()
    others = [
        f"{name} {began[name]} (now {now[name]})" for name in now if began.get(name, now[name]) != now[name]
    ]
    if others:
        print(
            f"the run began with {', '.join(others)}: it may end otherwise than it would have",
            file=sys.stderr,
        )


def _learn(model: BaseAlgorithm, run: Run, monitor: Monitor) -> None:
    restored, passed_over = run.restore(model)
    for reason in passed_over:
        print(f"passed over a damaged checkpoint: {reason}", file=sys.stderr)
    if restored is not None:
        monitor.restore(restored)
    run.write_curve(monitor.curve)
    remaining = run.config.total_timesteps - model.num_timesteps
    if remaining > 0:
        callbacks = [monitor, TellElapsed()]
        model.learn(remaining, callbacks, None, reset_num_timesteps=restored is None)  # type: ignore[arg-type]
    run.save("final", model)


@contextmanager
def _logging(model: BaseAlgorithm, run: Run) -> Iterator[None]:
    folder = str(run.folder / "tensorboard")
    logger = Logger(folder, [TensorBoardOutputFormat(folder)])
    model.set_logger(logger)
    try:
        yield
    finally:
        logger.close()
