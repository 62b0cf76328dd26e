"""Callback of training runs: validation, checkpoints, logs and progress."""

from __future__ import annotations

import shlex
import signal
import sys
import threading
import time
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from viapoint.training.evaluation.evaluator import MethodResult, evaluate_methods
from viapoint.training.io.progress import progress_bar
from viapoint.training.planning.baselines import agent_method
from viapoint.training.planning.search import registered_task
from viapoint.training.rollouts.rollout import whole_task
from viapoint.training.rollouts.vec_env import ViaVecEnv
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import FrozenScenes, scenes_for

LOG_EVERY = 1_000
"""Decisions between two entries of the log."""
RECENT = 20
"""Steps of all environments over which outcomes are averaged for log and progress bar."""
RATES = ("collision", "reachable")
"""Metrics of an episode that are true or false; Stable-Baselines3 logs the success itself."""
VALIDATED = ("success", "collision", "min_clearance", "goal_error", "jerk_ratio", "duration")
"""Metrics of a validation in the log and in the learning curve; medians in [m] and [s]."""


class TrainingStoppedError(Exception):
    """Training was stopped by Ctrl-C after its state was saved."""

    exit_code = 130
    """Exit code of shells for Ctrl-C."""


class TrainingStalledError(Exception):
    """Training ended before its limit, as the success on the validation scenes did not rise any more."""


class RunCallback(BaseCallback):
    """Callback that validates, keeps the best model, writes checkpoints and logs, and shows progress.

    It acts between two collections of experience, when the state of a run is complete. It draws no random numbers of
    the learner, so it does not change the result. Use it as a context around `learn`: inside, the first Ctrl-C saves
    and stops, the second stops at once.
    """

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run, self.config = run, run.config
        self.curve: list[dict[str, Any]] = []
        """Learning curve: one record for each evaluation so far."""
        self._best = (-1.0, 0.0)
        self._seconds_before, self._began = 0.0, time.monotonic()
        checkpoint, evaluation = self.config.checkpoint_interval, self.config.evaluation_interval
        self._every = {"log": LOG_EVERY, "checkpoint": checkpoint, "evaluation": evaluation}
        self._next = {**self._every, "evaluation": 0}
        self._validation = validation_scenes(run) if evaluation else None
        self._recent: list[dict[str, float]] = []
        self._stop = False

    def state(self) -> dict[str, Any]:
        """Return the state as plain values for :meth:`restore`."""
        best, following = list(self._best), dict(self._next)
        return {"curve": self.curve, "best": best, "seconds": self.seconds, "next": following}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a state that :meth:`state` returned."""
        self.curve, self._seconds_before = list(state["curve"]), float(state["seconds"])
        self._best = (float(state["best"][0]), float(state["best"][1]))
        self._next = {name: int(state["next"][name]) for name in self._next}

    @property
    def seconds(self) -> float:
        """Wall time of training, with earlier parts of the run and without validation, [s]."""
        return self._seconds_before + time.monotonic() - self._began

    def __enter__(self) -> RunCallback:
        task = self.config.env.rpartition("/")[2]
        self._bar = progress_bar(
            total=self.config.total_timesteps,
            unit=" decisions",
            desc=f"{self.config.algo} on {task}",
            disable=None if self.config.progress else True,
        )
        self._listens = threading.current_thread() is threading.main_thread()
        if self._listens:
            self._handler = signal.signal(signal.SIGINT, self._on_interrupt)
        return self

    def __exit__(self, *error: object) -> None:
        if self._listens:
            signal.signal(signal.SIGINT, self._handler)
        self._bar.close()

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._stop = True
        self._bar.write("saving and leaving; Ctrl-C again leaves at once", file=sys.stderr)

    def _on_training_start(self) -> None:
        self._began = time.monotonic()
        self._show_progress()

    def _on_step(self) -> bool:
        env = self.training_env
        if isinstance(env, ViaVecEnv) and env.last_outcome:
            self._recent.append({name: float(np.mean(env.last_outcome[name])) for name in env.last_outcome})
            del self._recent[:-RECENT]
        self._show_progress()
        return True

    def _on_rollout_start(self) -> None:
        self._run_due_actions(final=False)
        if self._stop:
            self._save_checkpoint()
            self.run.save("final", self.model)
            raise TrainingStoppedError(
                f"stopped after {self.num_timesteps} decisions, and all is saved; go on with: "
                f"{resume_command(self.run)}"
            )
        if self.run.stalled:
            self._save_checkpoint()
            raise TrainingStalledError

    def _on_training_end(self) -> None:
        self._run_due_actions(final=True)

    def _run_due_actions(self, *, final: bool) -> None:
        validates = self._validation is not None and (self._is_due("evaluation") or final)
        if self._validation is not None and validates:
            self._validate(self._validation)
        if self._is_due("log") or validates or final:
            self._log()
        if self._is_due("checkpoint") or final:
            self._save_checkpoint()

    def _is_due(self, what: str) -> bool:
        """Return whether an action is due, and schedule the next one if so."""
        if self.num_timesteps < self._next[what]:
            return False
        self._next[what] = (self.num_timesteps // self._every[what] + 1) * self._every[what]
        return True

    def _save_checkpoint(self) -> None:
        self.run.checkpoint(self.model, self.state())

    def _validate(self, frozen: FrozenScenes) -> None:
        """Evaluate the policy, extend the learning curve, and save the model if it is the best so far."""
        if self.curve and self.curve[-1]["decisions"] == self.num_timesteps:
            return
        seconds, began = self.seconds, time.monotonic()
        result = evaluate_methods(
            [agent_method("agent", self.model)],
            frozen,
            self.config.env,
            env_kwargs=whole_task(self.config.env, self.config.env_kwargs),
            time_decisions=False,
        ).results[0]
        if result.partial:
            return
        record = self._record(result, seconds)
        self.curve.append(record)
        self.run.write_curve(self.curve)
        if self.config.progress and self._bar.disable:
            rate = 100.0 * record["success"]["rate"]
            print(
                f"{self.num_timesteps} of {self.config.total_timesteps} decisions: success {rate:.1f} % in validation",
                file=sys.stderr,
                flush=True,
            )
        ranking = (record["success"]["rate"], -(record["jerk_ratio"] or 0.0))
        if ranking > self._best:
            self._best = ranking
            self.run.save("best", self.model)
        self._show_progress()
        self._began += time.monotonic() - began

    def _record(self, result: MethodResult, seconds: float) -> dict[str, Any]:
        env, summary = self.training_env, result.summary()
        steps = env.physics_steps if isinstance(env, ViaVecEnv) else 0
        record = {
            "decisions": self.num_timesteps,
            "physics_steps": steps,
            "simulated_seconds": round(steps * _timestep(env), 6) if steps else 0.0,
            "seconds": round(seconds, 3),
            "success_by_band": summary["success_by_band"],
            **{name: summary[name] for name in VALIDATED},
        }
        for name in VALIDATED:
            if isinstance(record[name], dict):
                self.logger.record(f"validation/{name}_rate", record[name]["rate"])
            elif record[name] is not None:  # the median of no values
                self.logger.record(f"validation/{name}", record[name])
        return record

    def _log(self) -> None:
        for name in {name for each in self._recent for name in each} - {"is_success"}:
            tag = f"rollout/{name}_rate" if name in RATES else f"rollout/{name}"
            self.logger.record(tag, self._average(name))
        env = self.training_env
        if isinstance(env, ViaVecEnv) and env.physics_steps:
            self.logger.record("time/simulated_seconds", env.physics_steps * _timestep(env))
        self.model.dump_logs()

    def _average(self, name: str) -> float:
        return float(np.mean([each[name] for each in self._recent if name in each]))

    def _show_progress(self) -> None:
        self._bar.update(min(self.num_timesteps, self.config.total_timesteps) - self._bar.n)
        shown = {}
        if self._recent:
            shown["success"] = f"{100.0 * self._average('is_success'):.0f} %"
        if self.curve:
            shown["validation"] = f"{100.0 * self.curve[-1]['success']['rate']:.1f} %"
        self._bar.set_postfix(shown, refresh=False)


def resume_command(run: Run) -> str:
    """Return the command that goes on with a run."""
    return shlex.join(["viapoint", "train", "--resume", "--out", str(run.folder)])


def _timestep(env: Any) -> float:
    """Return the timestep of the physics, [s]."""
    return float(env.get_attr("model", [0])[0].opt.timestep)


def validation_scenes(run: Run) -> FrozenScenes:
    """Return the shipped validation scenes of a run's environment, or reproducibly sampled ones if none fit."""
    config = run.config
    frozen = scenes_for("validation", registered_task(config.env, **config.env_kwargs), config.eval_scenes)
    return frozen.take(slice(0, config.eval_scenes))
