"""Run folders: all files of one training.

arm.xml                           copy of the arm, if it was loaded from a file
config.json  versions.json        what was asked for, with which versions (the seed is in config.json)
learning_curve.jsonl              one line for each evaluation on the validation scenes
checkpoints/<decisions>.pt        for an exact continuation; the last two are kept
best/  final/                     models: best on the validation scenes, last
evaluations/<name>.json           what `viapoint evaluate` and `viapoint demo` measured
tensorboard/                      logs
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm

from viapoint.envs.arms.stored import COPY, keep_arm, with_kept_arm
from viapoint.training import files
from viapoint.training.agents.agent import best_model
from viapoint.training.agents.model_io import save_model
from viapoint.training.checkpoints import read_checkpoint, write_checkpoint
from viapoint.training.checks import check_folder
from viapoint.training.configs import TrainConfig
from viapoint.training.files import BadFileError, as_plain, read_json, write_json

KEPT_CHECKPOINTS = 2
PATIENCE = 10.0  # [s]; workers of a study that was killed end within seconds

MAY_CHANGE = ("n_timesteps", "out", "resume", "progress")  # When a run is resumed
UNSET = object()  # Value of a setting that is not there


class Run:
    """Run folder, which holds everything about one training.

    Args:
        folder: Folder of an existing run.

    Raises:
        BadFileError: The folder is not a run.

    Example:
        >>> import tempfile
        >>> from viapoint.training import Run, TrainConfig, train
        >>> folder = tempfile.mkdtemp()
        >>> config = TrainConfig(
        ...     env="viapoint/PlanarReach-v0", n_timesteps=32, n_envs=16, eval_scenes=8, out=folder, progress=False
        ... )
        >>> run = train(config)
        >>> run = Run(folder)  # at any later time
        >>> run.decisions, run.best.name, [record["decisions"] for record in run.curve]
        (32, 'best', [0, 32])
    """

    def __init__(self, folder: str | Path) -> None:
        folder = Path(folder).expanduser()
        if not (folder / "config.json").is_file():
            raise BadFileError(folder, "is no run folder: it holds no config.json")
        self.folder = folder
        record = read_json(folder / "config.json")
        try:
            missing = {"env", "algo", "seed", "n_timesteps"} - record.keys()
            if missing:
                raise ValueError(f"without {', '.join(sorted(missing))}")
            if isinstance(record.get("env_kwargs"), dict):
                record["env_kwargs"] = with_kept_arm(record["env_kwargs"], folder)
            record["env"] = str(record["env"]).rpartition(":")[2]  # a file names no module to import
            self.config: TrainConfig = TrainConfig(**record)
        except (TypeError, ValueError) as error:
            reason = f"is no configuration of a training here: {error}"
            written = files.written_by(self.versions.get("viapoint"))
            raise BadFileError(folder / "config.json", reason + written) from None

    def __repr__(self) -> str:
        config = self.config
        stalled = " until it stalled" if self.stalled else ""
        curve = self.curve
        rate = f", success {100.0 * curve[-1]['success']['rate']:.1f} % on validation scenes" if curve else ""
        return (
            f"Run({str(self.folder)!r}: {config.algo} on {config.env}, seed {config.seed}, "
            f"{self.decisions} of {max(self.decisions, config.total_timesteps)} decisions{stalled}{rate})"
        )

    @classmethod
    def create(cls, config: TrainConfig) -> Run:
        """Create the folder of a new run; one with a run or something else raises BadFileError."""
        folder = config.folder
        check_free(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder):
            check_free(folder)  # another process may have been faster
            write_json(folder / "versions.json", files.versions())
            keep_arm(folder, config.task.arm)
            # The file that makes a folder a run comes last; it does not hold the arguments of one call.
            write_json(folder / "config.json", {**as_plain(config), "out": None, "resume": False})
        return cls(folder)

    @property
    def versions(self) -> dict[str, Any]:
        """Versions of packages at the start of the run; empty if the file is unreadable."""
        try:
            return read_json(self.folder / "versions.json")
        except BadFileError:
            return {}

    @property
    def curve(self) -> list[dict[str, Any]]:
        """Learning curve: one record for each evaluation; a damaged one raises BadFileError."""
        path = self.folder / "learning_curve.jsonl"
        lines = files.read_bytes(path, files.LARGEST_JSON).splitlines() if path.exists() else []
        try:
            records: list[dict[str, Any]] = [json.loads(line) for line in lines]
            for record in records:
                int(record["decisions"]), float(record["success"]["rate"]), float(record["jerk_ratio"] or 0.0)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise BadFileError(path, f"is no learning curve ({type(error).__name__}: {error})") from None
        return records

    def write_curve(self, records: list[dict[str, Any]]) -> None:
        """Replace the learning curve."""
        content = "".join(json.dumps(record, allow_nan=False) + "\n" for record in records)
        files.write_bytes(self.folder / "learning_curve.jsonl", content.encode())

    @property
    def decisions(self) -> int:
        """Number of decisions at the newest checkpoint; 0 without one."""
        checkpoints = self.checkpoints()
        return int(checkpoints[-1].stem) if checkpoints else 0

    @property
    def best(self) -> Path:
        """Folder of the best model on the validation scenes, or of the last model if training did not validate."""
        return best_model(self.folder)

    @property
    def final(self) -> Path:
        """Folder of the last model, which exists once training has ended."""
        return self.folder / "final"

    def save(self, name: str, model: BaseAlgorithm) -> None:
        """Write a model as `best` or `final`; a folder with other files is kept as `best.1`, as training must go on."""
        files.write_folder(self.folder / name, partial(save_model, model), move_foreign=True)

    def checkpoint(self, model: BaseAlgorithm, seconds: float) -> None:
        """Write a checkpoint of a training that has taken a time, [s], and remove outdated ones."""
        write_checkpoint(model, self.folder / "checkpoints" / f"{model.num_timesteps:010d}.pt", seconds)
        for outdated in self.checkpoints()[:-KEPT_CHECKPOINTS]:
            outdated.unlink()

    def checkpoints(self) -> list[Path]:
        """Files of the checkpoints, oldest first."""
        found = (self.folder / "checkpoints").glob(10 * "[0-9]" + ".pt")
        return sorted(path for path in found if path.is_file())

    def restore(self, model: BaseAlgorithm) -> float | None:
        """Set a model to the state of the newest intact checkpoint, and print why newer ones were skipped.

        The result is the time of the training so far, [s], or None without any checkpoint. Where none is whole,
        BadFileError is about the newest; it is raised, too, where those of a training that has ended are gone.
        """
        newest = None
        for path in reversed(self.checkpoints()):
            try:
                return read_checkpoint(model, path)
            except BadFileError as error:
                print(f"passed over a damaged checkpoint: {error}", file=sys.stderr)
                newest = newest or error
        if newest is not None:
            raise newest
        if self.final.exists():
            raise BadFileError(self.folder / "checkpoints", "holds no checkpoint to go on from")
        if self.curve:
            print(f"{self.folder} holds no checkpoint: the training begins anew", file=sys.stderr)
        return None

    @property
    def stalled(self) -> bool:
        """Flag: success had not risen for so long that training ended, see `stop_when_stalled`."""
        share = self.config.stop_when_stalled
        curve = [] if share is None else self.curve
        if share is None or not curve:
            return False
        now = curve[-1]["decisions"]
        best = max(curve, key=lambda record: record["success"]["rate"])  # the first of several
        return bool(now >= self.config.preset.n_timesteps and now - best["decisions"] >= share * now)

    @property
    def ended(self) -> bool:
        """Flag: training has made all its decisions, or success stalled, and the last model is written."""
        enough = self.stalled or self.decisions >= self.config.total_timesteps
        return enough and (self.final / "model.json").is_file()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a run folder for this process, and tidy up what a crash left in it; in use, it raises BadFileError.

    The operating system unlocks it when the process ends.
    """
    try:
        held = FileLock(folder / "lock").acquire(timeout=PATIENCE)
    except Timeout:
        raise BadFileError(folder, "is in use by another process") from None
    with held:
        for name in (".", "checkpoints", "evaluations"):
            files.tidy(folder / name)
        yield


def check_free(folder: Path) -> None:
    """Check that a folder can be written to and holds nothing but what an attempt to create a run left there."""
    if (folder / "config.json").exists():
        raise BadFileError(folder, "holds a run already; continue it with --resume or name another folder")
    check_folder(f"run folder {folder}", folder)
    for path in folder.glob("*"):
        if path.name not in ("versions.json", COPY, "lock") and not files.UNFINISHED.fullmatch(path.name):
            raise BadFileError(folder, f"holds {path.name} and is no run folder; name an empty or a new one")
    files.check_ours(folder / "versions.json")


def check_unchanged(run: Run, config: TrainConfig, usual: TrainConfig | None = None) -> None:
    """Check that a run goes on with its own settings; others raise BadFileError.

    Where `usual` settings are given, those asked for that equal them are left to the run.
    """
    begun, asked = _settings(run.config), _settings(config)
    names = asked.keys() | begun.keys()
    if usual is not None:
        default = _settings(usual)
        names = {name for name, value in asked.items() if value != default.get(name, UNSET)}
    others = sorted(name for name in names if asked.get(name, UNSET) != begun.get(name, UNSET))
    if others:
        had = ", ".join(f"{name} {begun.get(name, 'as usual')}" for name in others)
        advice = "--resume goes on with it: leave these flags out, or name another folder for other settings"
        raise BadFileError(run.folder, f"holds a run with {had}; {advice}")


def _settings(config: TrainConfig) -> dict[str, Any]:
    """Return the settings that may not change, those in fields with several by their own names."""
    values = as_plain(config)
    values |= {**values.pop("env_kwargs"), **values.pop("hyperparameters")}
    return {name: value for name, value in values.items() if name not in MAY_CHANGE}
