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
from viapoint.training.rollouts.rollout import whole_task
from viapoint.training.rollouts.vec_env import LOGGED, ViaVecEnv
from viapoint.training.runs.run_dir import Run
from viapoint.training.scene_sets.scene_set import FrozenScenes, scenes_for

LOG_EVERY = 1_000  # Decisions between two entries of the log
RATES = ("collision", "reachable")  # Metrics that are true or false
# Metrics of a validation in the log and in the learning curve; medians in [m] and [s]
VALIDATED = ("success", "collision", "min_clearance", "goal_error", "jerk_ratio", "duration")


class TrainingStoppedError(Exception):
    """Training was stopped by Ctrl-C after its state was saved."""

    exit_code = 130  # Exit code of shells for Ctrl-C


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
        self.curve: list[dict[str, Any]] = []  # one record for each evaluation so far
        self._seconds_before, self._began = 0.0, time.monotonic()
        self._before = 0  # Decisions when it was last decided what is due
        self._validation: FrozenScenes | None = None
        if self.config.evaluation_interval:
            self._validation = scenes_for("validation", self.config.task, self.config.eval_scenes)
        self._stop = False

    def restore(self, seconds: float, decisions: int) -> None:
        """Continue a training that took a time [s] for a number of decisions."""
        self.curve = [record for record in self.run.curve if record["decisions"] <= decisions]
        self._seconds_before, self._before = seconds, decisions

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
        config = self.config
        validates = self._validation is not None and (
            final or not self.curve or self._is_due(config.evaluation_interval)
        )
        if validates:
            self._validate()
        if validates or final or self._is_due(LOG_EVERY):
            self._log()
        saves = final or self._is_due(config.checkpoint_every or config.preset.checkpoint_every)
        self._before = self.num_timesteps
        if saves:
            self._save_checkpoint()

    def _is_due(self, interval: int) -> bool:
        """Return whether decisions have passed a multiple of an interval."""
        return self.num_timesteps // interval > self._before // interval

    def _save_checkpoint(self) -> None:
        self.run.checkpoint(self.model, {"seconds": self.seconds})

    def _validate(self) -> None:
        """Evaluate the policy, extend the learning curve, and save the model if it is the best so far."""
        if self._validation is None or (self.curve and self.curve[-1]["decisions"] == self.num_timesteps):
            return
        seconds = self.seconds
        began = time.monotonic()
        if hasattr(self.model, "calibrate"):  # of agents that predict their success
            self.model.calibrate()
        result = evaluate_methods(
            [agent_method("agent", self.model)],
            self._validation,
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
        # A validation is better with more success, then with less jerk.
        best = max(self.curve, key=lambda each: (each["success"]["rate"], -(each["jerk_ratio"] or 0.0)))
        if record is best:
            self.run.save("best", self.model)
        self._show_progress()
        self._began += time.monotonic() - began

    def _record(self, result: MethodResult, seconds: float) -> dict[str, Any]:
        """Return the record of a validation for the learning curve, and log it."""
        summary = result.summary()
        env = self.training_env
        assert isinstance(env, ViaVecEnv)
        record = {
            "decisions": self.num_timesteps,
            "physics_steps": env.physics_steps,
            "seconds": round(seconds, 3),
            "success_by_band": summary["success_by_band"],
        }
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
        shown = {}
        if self.model.ep_success_buffer:
            shown["success"] = f"{100.0 * np.mean(self.model.ep_success_buffer):.0f} %"
        if self.curve:
            shown["validation"] = f"{100.0 * self.curve[-1]['success']['rate']:.1f} %"
        self._bar.set_postfix(shown, refresh=False)


def resume_command(run: Run) -> str:
    """Return the command that goes on with a run."""
    return shlex.join(["viapoint", "train", "--resume", "--out", str(run.folder)])
