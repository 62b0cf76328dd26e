"""Run folders, all files of one training, and checkpoints, from which it continues as if it had never stopped.

arm.xml                           copy of the arm, if it was loaded from a file
config.json  versions.json        what was asked for, with which versions (the seed is in config.json)
learning_curve.jsonl              one line for each evaluation on the validation scenes
checkpoints/<decisions>.pt        for an exact continuation; the last two are kept
best/  final/                     models: best on the validation scenes, last
evaluations/<name>.json           what `viapoint evaluate` and `viapoint demo` measured
tensorboard/                      logs

A checkpoint is taken between the collection of experience and the next, when SB3 holds nothing in local variables. It
is one file of `torch.save`, written whole or not at all, and read with `weights_only=True`, so no code of it is run.
"""

from __future__ import annotations

import io
import json
import random
import sys
import zipfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr
from torch.utils._pytree import tree_map, tree_map_only

from viapoint.envs.arms.registry import ARM_FILES
from viapoint.envs.arms.stored import COPY, keep_arm, with_kept_arm
from viapoint.training import files
from viapoint.training.agents.agent import best_model
from viapoint.training.agents.model_io import describe, save_model
from viapoint.training.checks import check_folder
from viapoint.training.configs import TrainConfig
from viapoint.training.files import BadFileError, as_plain, read_json, write_json
from viapoint.training.vec_env import ViaVecEnv

KEPT_CHECKPOINTS = 2
PATIENCE = 10.0  # [s]; workers of a study that was killed end within seconds

MAY_CHANGE = ("n_timesteps", "out", "resume", "progress")  # When a run is resumed
UNSET = object()  # Value of a setting that is not there

FORMAT = 3
# Counters of Stable-Baselines3's algorithms
COUNTERS = (
    "seed",
    "num_timesteps",
    "_total_timesteps",
    "_episode_num",
    "_n_updates",
    "_current_progress_remaining",
)
ARRAYS = ("_last_obs", "_last_episode_starts")
DEQUES = ("ep_info_buffer", "ep_success_buffer")
MAY_DIFFER = ("num_timesteps", "viapoint")  # Entries that do not tell models apart


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


def write_checkpoint(model: BaseAlgorithm, path: Path, seconds: float) -> None:
    """Write the complete state of a training run that has taken a time, [s]."""
    env = model.get_env()
    assert isinstance(env, ViaVecEnv)
    arrays = {
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "recent": {name: list(getattr(model, name) or ()) for name in DEQUES},
        "last": {name: getattr(model, name) for name in ARRAYS},
        "buffer": {},
        "random": {
            "python": random.getstate(),
            "numpy": np.random.get_state(legacy=False),  # noqa: NPY002 - SB3 draws from it
            "actions": model.action_space.np_random.bit_generator.state,
        },
        "env": env.state(),
    }
    buffer: Any = getattr(model, "replay_buffer", None)  # a rollout buffer is empty between two collections
    if buffer is not None:
        filled = tree_map_only(np.ndarray, lambda array: array[: buffer.size()], _buffer_arrays(buffer))
        arrays["buffer"] = {"pos": buffer.pos, "full": buffer.full, "arrays": filled}
    state = {
        "format": FORMAT,
        "model": describe(model),
        "parameters": model.get_parameters(),
        "variables": {name: variable.detach() for name, variable in _variables(model).items()},
        "torch_random": torch.get_rng_state(),
        "arrays": tree_map_only((np.ndarray, np.generic), _to_torch, arrays),
        "extra": {"seconds": seconds},
    }
    content = io.BytesIO()
    torch.save(state, content)
    files.write_bytes(path, content.getvalue())


def read_checkpoint(model: BaseAlgorithm, path: Path) -> float:
    """Set a newly built model and its environment to the state of a checkpoint, and return the time so far, [s].

    A checkpoint that is torn, foreign, or of another model raises BadFileError.
    """
    state = read_state(path)
    written = files.written_by(state["model"].get("viapoint"))
    mine = _with_any_file(describe(model))
    theirs = _with_any_file(state["model"])
    others = [name for name in mine if name not in MAY_DIFFER and mine[name] != theirs.get(name)]
    if others:
        raise BadFileError(path, f"is of another model: {', '.join(others)}{written}")
    try:
        _restore(model, state, tree_map_only(torch.Tensor, torch.Tensor.numpy, state["arrays"]))
        return float(state["extra"]["seconds"])
    except Exception as error:  # of a library, for content that does not fit the model
        reason = f"does not fit the model ({type(error).__name__}: {error})"
        raise BadFileError(path, reason + written) from None


def _with_any_file(record: Any) -> Any:
    """Return a description of a model, in which all arms of files have the same name.

    A run goes on with the copy of its arm where the file is gone, and with the file where it is there again.
    """

    def renamed(part: dict[str, Any]) -> dict[str, Any]:
        return {**part, "arm": COPY} if str(part.get("arm")).endswith(ARM_FILES) else part

    return json.loads(json.dumps(record), object_hook=renamed)


def read_state(path: Path) -> dict[str, Any]:
    """Return the content of a checkpoint after checking the sums of its parts; a bad one raises BadFileError."""
    content = io.BytesIO(files.read_bytes(path))
    try:
        with zipfile.ZipFile(content) as archive:
            torn = archive.testzip()
        if torn is not None:
            raise ValueError(f"the sum of {torn} is another one")
        content.seek(0)  # for a second reader
        state = torch.load(content, weights_only=True)
        if state["format"] != FORMAT or not isinstance(state["model"], dict):
            raise ValueError(f"format must be {FORMAT}")
    except Exception as error:  # of a library, for content that is none of a checkpoint
        raise BadFileError(path, f"is no whole checkpoint ({' '.join(str(error).split())[:200]})") from None
    return dict(state)


def _restore(model: BaseAlgorithm, state: dict[str, Any], arrays: dict[str, Any]) -> None:
    """Set the attributes that a checkpoint holds; the code determines which ones, never the file."""
    model.set_parameters(state["parameters"], exact_match=True)
    for name in _variables(model):
        recursive_setattr(model, f"{name}.data", state["variables"][name])
    for name in COUNTERS:
        setattr(model, name, arrays["counters"][name])
    for name in ARRAYS:
        setattr(model, name, arrays["last"][name])
    for name in DEQUES:
        setattr(model, name, deque(arrays["recent"][name], maxlen=model._stats_window_size))
    buffer: Any = getattr(model, "replay_buffer", None)
    if buffer is not None:
        tree_map(_fill, _buffer_arrays(buffer), arrays["buffer"]["arrays"])
        buffer.pos = arrays["buffer"]["pos"]
        buffer.full = arrays["buffer"]["full"]
    env: Any = model.get_env()
    env.restore(arrays["env"])
    # Last: nothing may be drawn after it.
    random.setstate(arrays["random"]["python"])
    np.random.set_state(arrays["random"]["numpy"])  # noqa: NPY002 - SB3 draws from it
    model.action_space.np_random.bit_generator.state = arrays["random"]["actions"]
    torch.set_rng_state(state["torch_random"])


def _variables(model: BaseAlgorithm) -> dict[str, Any]:
    """Return tensors outside of modules and optimisers, such as SAC's entropy coefficient."""
    return {name: recursive_getattr(model, name) for name in model._get_torch_save_params()[1]}


def _buffer_arrays(buffer: Any) -> dict[str, Any]:
    """Return the arrays of a replay buffer, and the dictionaries that hold those of observations."""
    return {name: each for name, each in vars(buffer).items() if isinstance(each, np.ndarray | dict)}


def _fill(array: Any, saved: Any) -> None:
    """Set the first rows of an array to saved ones; other attributes of a buffer are the same in all."""
    if isinstance(array, np.ndarray):
        array[: len(saved)] = saved


def _to_torch(value: Any) -> Any:
    """Return an array as a tensor, which `torch.load` reads without code, and a NumPy scalar as a number."""
    if isinstance(value, np.generic):
        return value.item()
    return torch.from_numpy(np.require(value, requirements=["C", "W"]))
