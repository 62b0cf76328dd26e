"""Scene sets: frozen sets in files, and sets that are drawn anew."""

from __future__ import annotations

import dataclasses
import hashlib
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.envs.geometry.rows import CAPSULES, SHAPE_SIZE, has_shapes
from viapoint.envs.registration import OWN_ARM_TASKS, REPLANNING_TASKS
from viapoint.envs.scenes.dynamic_scene import ChangingScenes
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.rollouts.rollout import new_simulation

SETS = ("validation", "test", "hard", "uniform")
"""Names of the sets; an environment need not have all."""
BANDS = ("> 20 %", "5-20 %", "1-5 %", "< 1 %")
"""Bands of the solution share, from easy to hard."""
BAND_EDGES = (0.2, 0.05, 0.01)
DRAWN = ""
"""Family of the scenes that are drawn from the training distribution."""
MEASURED = ("share", "solution")
"""Measured values of each scene."""
PER_SCENE = (*MEASURED, "family", "number")
"""Fields of a set that have one entry for each scene, besides the scenes."""
LARGEST = 1 << 30
"""Limit of the memory of a file's arrays, [bytes], enough for a million scenes: a small archive can claim any size."""


def bands(share: Float) -> NDArray[np.int64]:
    """Return the index into BANDS of each solution share, shape (N,)."""
    return np.searchsorted(-np.array(BAND_EDGES), -share, side="right").astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class FrozenScenes:
    """Set of N scenes."""

    name: str
    """Name of the set, or path of its file."""
    env_id: str
    scenes: Any
    """N :class:`~viapoint.envs.scenes.scene.Scenes`, or :class:`~viapoint.envs.scenes.dynamic_scene.ChangingScenes`."""
    share: Float
    """Solution share: the fraction of uniformly random actions that succeed in simulation, shape (N,); NaN if
    unknown."""
    solution: Float
    """Actions that the planner found and the simulation confirmed, shape (N, m)."""
    family: Any = DRAWN
    """Name of each scene's family, shape (N,), or one for all; DRAWN for the training distribution."""
    number: Any = -1
    """Numbers among the scenes drawn for the set, shape (N,); -1 if unknown."""

    def __post_init__(self) -> None:
        """Expand names and numbers to all scenes."""
        for name, kind in (("family", np.str_), ("number", np.int64)):
            values = np.broadcast_to(np.asarray(getattr(self, name), dtype=kind), self.share.shape)
            object.__setattr__(self, name, values)

    @property
    def band(self) -> NDArray[np.int64]:
        """Index into BANDS, shape (N,); -1 where the share is unknown."""
        return np.where(np.isnan(self.share), -1, bands(self.share))

    @property
    def sha256(self) -> str:
        """Hash of scenes, shares and families; file compression and solutions do not count."""
        digest = hashlib.sha256(self.env_id.encode())
        content = self.arrays()
        del content["solution"]
        for name, array in content.items():
            digest.update(f"{name}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        digest.update("\n".join(("family", *self.family)).encode())
        return digest.hexdigest()

    def arrays(self) -> dict[str, Float]:
        """Return the arrays by name."""
        return {**self.scenes._asdict(), **{name: getattr(self, name) for name in MEASURED}}

    def save(self, path: Path) -> None:
        """Write the set with its hash."""
        names = ("env_id", "sha256", "family", "number")
        rest = {name: np.array(getattr(self, name)) for name in names}
        np.savez_compressed(path, **rest, **self.arrays())  # type: ignore[arg-type]

    def take(self, rows: Any) -> FrozenScenes:
        """Return the scenes at `rows`, an index array, slice or mask."""
        rest = {name: getattr(self, name)[rows] for name in PER_SCENE}
        return dataclasses.replace(self, scenes=self.scenes.take(rows), **rest)


def shipped_path(name: str, env_id: str) -> Path:
    """Return the path of a shipped set of an environment."""
    task = env_id.removeprefix("viapoint/").partition("-")[0]
    stem = "".join(f"_{c.lower()}" if c.isupper() else c for c in task).lstrip("_")
    return Path(str(files("viapoint.training") / "scenes" / f"{stem}_{name}.npz"))


def load(name_or_path: str | Path, env_id: str) -> FrozenScenes:
    """Load a set of scenes and check its hash.

    Args:
        name_or_path: One of SETS, or the path of a file.
        env_id: Environment of the scenes.

    Raises:
        ValueError: There is no such set, the file is not one, is damaged, or is for another environment.
    """
    path = shipped_path(str(name_or_path), env_id) if str(name_or_path) in SETS else Path(name_or_path)
    if not path.is_file():
        shipped = [name for name in SETS if shipped_path(name, env_id).is_file()]
        raise ValueError(
            f"scenes for {env_id} must be one of {', '.join(shipped)} or a file, got {name_or_path!s}"
        )
    kind, content = _read(path)
    scenes = kind(*(content[name] for name in kind._fields))
    rest: Any = {name: content[name] for name in PER_SCENE}
    frozen = FrozenScenes(name=str(name_or_path), env_id=str(content["env_id"]), scenes=scenes, **rest)
    if frozen.sha256 != str(content["sha256"]):
        raise ValueError(f"{path} is damaged: its content does not have the hash that it states")
    if frozen.env_id != env_id:
        raise ValueError(f"{path} holds scenes for {frozen.env_id}, not for {env_id}")
    return frozen


def _read(path: Path) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return the kind of scenes of a file, and its arrays, whose shapes are consistent."""
    try:
        with path.open("rb") as file:
            if not zipfile.is_zipfile(file):
                raise ValueError("it is no archive of arrays, or a part of one")
            with zipfile.ZipFile(file) as packed:
                size = sum(part.file_size for part in packed.infolist())
            if size > LARGEST:
                raise ValueError(f"its arrays would take {size} bytes, more than {LARGEST}")
            file.seek(0)
            with np.load(file, allow_pickle=False) as archive:
                kind: Any = ChangingScenes if "jumps" in archive else Scenes
                names = (*kind._fields, *PER_SCENE, "env_id", "sha256")
                content = {name: archive[name] for name in names}
        _check_content(kind, content)
    except Exception as error:  # an archive can be broken in any of its layers
        raise ValueError(f"{path} is not a file of scenes: {error or type(error).__name__}") from None
    return kind, content


def _check_content(kind: Any, content: dict[str, NDArray[Any]]) -> None:
    """Raise ValueError unless all arrays are of N > 0 scenes in the same D dimensions."""
    number, d = content["start"].shape if content["start"].ndim == 2 else (0, 0)
    obstacles = content["obstacles"].shape[1:2]
    shapes = SHAPE_SIZE * (content["obstacles"].ndim == 3 and has_shapes(content["obstacles"]))
    wanted: dict[str, tuple[int, ...]] = dict.fromkeys(("start", "goal"), (number, d))
    wanted |= {
        "obstacles": (number, *obstacles, 2 * d + 1 + shapes),
        "courses": (number, *obstacles, 2 * d + 1),
    }
    wanted |= {"jumps": (number, *content.get("jumps", content["goal"]).shape[1:2], d + 1)}
    wanted |= dict.fromkeys(("share", "family", "number"), (number,))
    wanted |= {"solution": (number, *content["solution"].shape[1:2])}
    for name in (*kind._fields, *PER_SCENE):
        shape, numbers = content[name].shape, content[name].dtype.kind in "fi"
        if shape != wanted[name] or not number or numbers is (name == "family"):
            raise ValueError(f"{name} of {number} scenes is {content[name].dtype} of shape {shape}")
    if not (np.isnan(content["share"]) | ((content["share"] >= 0.0) & (content["share"] <= 1.0))).all():
        raise ValueError("a solution share is not between 0 and 1")


OTHER_ARGUMENTS = frozenset(
    {"n_via", "timing", "reward_weights", "threads", "render_mode", "width", "height"}
)
"""Arguments of an environment with which frozen scenes remain scenes of it; without replanning, `duration_range` is
another."""
SEEDS = {"validation": 1_000_003, "test": 2_000_003}
"""Seeds of the sets that can be drawn, far from training seeds and from each other."""
NUMBERS = {"validation": 500, "test": 1_000}
"""Number of scenes of such a set."""


def scene_arguments(env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of an environment with which frozen scenes are no scenes of it."""
    others = OTHER_ARGUMENTS if env_id in REPLANNING_TASKS else OTHER_ARGUMENTS | {"duration_range"}
    return {name: value for name, value in env_kwargs.items() if name not in others}


def frozen_fit(name: str, env_id: str, env_kwargs: Mapping[str, Any]) -> bool:
    """Return True if a set is shipped for an environment with these arguments."""
    return shipped_path(name, env_id).is_file() and not scene_arguments(env_id, env_kwargs)


def drawn(name: str, env_id: str, env_kwargs: Mapping[str, Any], number: int) -> FrozenScenes:
    """Draw a set without shares and solutions; equal arguments give equal scenes."""
    simulation = new_simulation(env_id, 64 if env_id in REPLANNING_TASKS else 1, **env_kwargs)
    scenes = simulation.draw(number, SEEDS[name])
    simulation.close()
    share, solution = np.full(number, np.nan), np.zeros((number, simulation.task.action.size))
    return FrozenScenes(name="drawn", env_id=env_id, scenes=scenes, share=share, solution=solution)


def scenes_for(name_or_path: str, env_id: str, env_kwargs: Mapping[str, Any]) -> FrozenScenes:
    """Return the named scenes; where no frozen ones fit, draw them and print a line that says so.

    Raises:
        ValueError: There is no such set, or its scenes cannot be those of the environment.
    """
    others = scene_arguments(env_id, env_kwargs)
    if name_or_path not in SETS:
        frozen = load(name_or_path, env_id)
        _check_shapes(frozen, env_kwargs)
        return frozen
    if frozen_fit(name_or_path, env_id, env_kwargs) or not (others or env_id in OWN_ARM_TASKS):
        return load(name_or_path, env_id)
    made = f"{env_id} with {', '.join(f'{name}={value}' for name, value in others.items())}"
    where = made if others else env_id
    if name_or_path not in SEEDS:
        raise ValueError(
            f"there are no {name_or_path} scenes for {where}; scenes must be {', '.join(SEEDS)}, which are drawn "
            "for it, or a file"
        )
    print(f"no frozen {name_or_path} scenes are for {where}: they are drawn", file=sys.stderr)
    return drawn(name_or_path, env_id, env_kwargs, NUMBERS[name_or_path])


def _check_shapes(frozen: FrozenScenes, env_kwargs: Mapping[str, Any]) -> None:
    """Raise ValueError if the scenes of a file have another shape than those of the environment."""
    simulation = new_simulation(frozen.env_id, 1, **env_kwargs)
    layout, shapes = simulation.task.observation, simulation.task.scenes.shapes
    simulation.close()
    mine = layout.n_rows, layout.dimension
    theirs = frozen.scenes.present.shape[1], frozen.scenes.start.shape[1]
    kind = "several shapes" if has_shapes(frozen.scenes.obstacles) else "capsules"
    if mine != theirs or (kind == "capsules") != (shapes == CAPSULES):
        raise ValueError(
            f"{frozen.name} holds scenes of at most {theirs[0]} obstacles, {kind}, in {theirs[1]} dimensions; the "
            f"environment, made with {dict(env_kwargs)}, has {mine[0]} of {', '.join(shapes)} in {mine[1]}"
        )
