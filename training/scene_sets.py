"""Scene sets: frozen sets in files, and sets that are drawn anew."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.arrays import Float, Int
from viapoint.envs.geometry.obstacles import KINDS, no_obstacles
from viapoint.envs.geometry.shapes import IN_TABLES, PLAIN_KINDS
from viapoint.envs.scenes.scene import NEVER, Scenes, check_scenes
from viapoint.envs.sensors import VIEW_MARGIN, Sensor
from viapoint.envs.task import COURSES, Task

SHIPPED = Path(str(files("viapoint.training") / "scenes"))  # Sets of the package
SETS = ("validation", "test", "hard", "uniform")  # Names of the sets; a task need not have all
BANDS = ("> 20 %", "5-20 %", "1-5 %", "< 1 %")  # Bands of the solution share, from easy to hard
BAND_EDGES = (0.2, 0.05, 0.01)
DRAWN = ""  # Family of the scenes that are drawn as in training
SEEDS = {"validation": 1_000_003, "test": 2_000_003}  # Far from training seeds
NUMBERS = {"validation": 500, "test": 1_000}  # Number of scenes of such a set
LARGEST = 1 << 30  # Limit of a file's arrays, [bytes]: small archives can claim any size
SCENE_PARTS = ("start", "goal", "jumps", "turn_time", "turn_velocity", "reach")  # Arrays of `Scenes`
OBSTACLE_PARTS = ("centre", "rotation", "size", "velocity")  # Arrays of `Obstacles` beside kind
# Arrays of a file, with one entry for each scene
CONTENT = ("start", "goal", "kind", *OBSTACLE_PARTS, "jumps", "turn_time", "turn_velocity", "share", "family")
REACH = "reach"  # Array of a file where obstacles are on reaches
# Fields of a task that say which scenes are scenes of it, besides kinds and families of obstacles
SCENE_FIELDS = ("arm", "n_obstacles", "whole_arm", "moving_obstacles", "n_jumps")


@dataclass(frozen=True, kw_only=True)
class FrozenScenes:
    """Set of N scenes.

    Example:
        >>> import gymnasium as gym
        >>> import numpy as np
        >>> from viapoint.training import FrozenScenes
        >>> envs = gym.make_vec("viapoint.envs:viapoint/PlanarObstacles-v0", num_envs=2)
        >>> _ = envs.reset(seed=0)
        >>> share, family = np.full(2, np.nan), np.full(2, "mine")
        >>> mine = FrozenScenes(name="mine", task=envs.task.as_dict(), scenes=envs.scenes, share=share, family=family)
        >>> mine.take([0]).scenes.start.shape
        (1, 2)
    """

    name: str  # Name of the set, or path of its file
    task: Mapping[str, Any]  # Task of the scenes, see :meth:`~viapoint.envs.task.Task.as_dict`
    scenes: Scenes  # N scenes, without meshes and point clouds
    share: Float  # Share of random actions whose plan is clear, shape (N,); NaN if unknown
    family: NDArray[np.str_]  # Name of each scene's family, shape (N,)

    @property
    def band(self) -> NDArray[np.int64]:
        """Index into BANDS, shape (N,); -1 where the share is unknown."""
        band = (self.share[:, None] <= np.array(BAND_EDGES)).sum(axis=1)
        return np.where(np.isnan(self.share), -1, band).astype(np.int64)

    @property
    def hidden(self) -> Float:
        """Share of obstacles that the sensor does not see at all in each scene, shape (N,); NaN without a sensor."""
        task = Task.of(**self.task)
        if task.sensor is None:
            return np.full(self.share.shape, np.nan)
        rotation, origin = task.sensor.pose(task.arm, self.scenes.start)
        hidden = task.sensor.hidden(rotation, origin, self.scenes.obstacles)
        return np.asarray(hidden.sum(axis=1) / np.maximum(self.scenes.obstacles.present.sum(axis=1), 1))

    @property
    def sha256(self) -> str:
        """Hash of task, scenes, shares and families; the compression of the file does not count."""
        digest = hashlib.sha256(json.dumps(self.task, sort_keys=True).encode())
        for name, array in self.arrays().items():
            digest.update(f"{name}{array.shape}".encode())
            numbers = array.dtype.kind != "U"
            digest.update(
                np.ascontiguousarray(array, dtype="<f8").tobytes() if numbers else "\n".join(array).encode()
            )
        return digest.hexdigest()

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of a file by name."""
        obstacles = self.scenes.obstacles
        parts = {**self.scenes._asdict(), **obstacles._asdict(), "share": self.share, "family": self.family}
        names = (*CONTENT, REACH) if self.scenes.reach.any() else CONTENT
        return {name: np.asarray(parts[name]) for name in names}

    def save(self, path: Path) -> None:
        """Write the set with its hash; numbers that single precision represents take half the place."""
        save_sets(path, {"": self})

    def take(self, rows: Any) -> FrozenScenes:
        """Return the scenes at `rows`, an index array, slice or mask."""
        return dataclasses.replace(
            self, scenes=self.scenes.take(rows), share=self.share[rows], family=self.family[rows]
        )

    def spread(self, count: int | None) -> FrozenScenes:
        """Return up to `count` scenes, evenly spread over the set; all if `count` is None."""
        return self.take(evenly_spread(len(self.share), count))


def evenly_spread(number: int, count: int | None) -> Int:
    """Return up to `count` rows of `number`, evenly spread from the first to the last; all if `count` is None."""
    kept = number if count is None else min(number, count)
    return np.linspace(0, number - 1, kept).round().astype(np.int64)


def save_sets(path: Path, sets: Mapping[str, FrozenScenes]) -> None:
    """Write sets by their names into one file; the arrays of a set are in a folder of its name."""
    arrays: dict[str, Any] = {}
    for name, frozen in sets.items():
        if np.isin(frozen.scenes.obstacles.kind, IN_TABLES).any():
            raise ValueError(f"frozen scenes must have obstacles of the kinds {', '.join(PLAIN_KINDS)} only")
        arrays |= {_place(name, part): _smallest(array) for part, array in frozen.arrays().items()}
        arrays[_place(name, "task")] = np.array(json.dumps(frozen.task))
        arrays[_place(name, "sha256")] = np.array(frozen.sha256)
    np.savez_compressed(path, **arrays)


def _place(name: str, part: str) -> str:
    """Return the name that an array of a set has in a file."""
    return f"{name}/{part}" if name else part


def shipped_path(env_id: str) -> Path:
    """Return the path of the file that holds the shipped sets of an environment."""
    return SHIPPED / f"{env_id.removeprefix('viapoint/')}.npz"


def shipped_set(name: str, task: Task) -> FrozenScenes | None:
    """Return the shipped set whose scenes are those of a task, or None if there is none."""
    for path in sorted(SHIPPED.glob("*.npz")):
        with np.load(path, allow_pickle=False) as archive:
            text = archive.get(_place(name, "task"))
        if text is None:
            continue
        frozen = json.loads(str(text))
        eye = Sensor(**frozen["sensor"]) if "sensor" in frozen else None
        same_eye = _eyes_agree(eye, task.sensor)
        if same_eye and _scene_key(frozen) == _scene_key(task.as_dict()):
            return load(path, name)
    return None


def _scene_key(task: Mapping[str, Any]) -> str:
    """Return what scenes of a task depend on, as text."""
    values = [task[name] for name in SCENE_FIELDS]
    values += [sorted(task["shapes"]), sorted(task["families"])]
    if task["moving_obstacles"] or any(task["n_jumps"]):
        values.append(task.get("courses", COURSES[0]))
        values.append(task["duration_range"])  # things happen at parts of the longest movement
    return json.dumps(values, sort_keys=True)


def _eyes_agree(frozen: Sensor | None, wanted: Sensor | None) -> bool:
    """Return True if scenes that were drawn for a sensor fit another one: obstacles keep away from one that rests."""
    if frozen is None or wanted is None:
        return frozen is wanted
    return wanted.mount == "hand" or (frozen.mount, frozen.position) == ("world", wanted.position)


def load(path: Path, name: str = "") -> FrozenScenes:
    """Load a set of scenes, the one with a name in a file of several, and check its hash.

    Raises:
        ValueError: The file is one of something else, or is damaged.
    """
    if not path.is_file():
        raise ValueError(f"there is no file of scenes {path}")
    try:
        with zipfile.ZipFile(path) as packed:
            size = sum(part.file_size for part in packed.infolist())
        if size > LARGEST:
            raise ValueError(f"its arrays would take {size} bytes, more than {LARGEST}")
        with np.load(path, allow_pickle=False) as archive:
            content = {part: archive[_place(name, part)] for part in (*CONTENT, "task", "sha256")}
            no_reach = np.zeros((*content["kind"].shape, 5))
            content[REACH] = archive.get(_place(name, REACH), no_reach)
        for part in (*CONTENT, REACH):
            if content[part].dtype.kind == "f":
                content[part] = content[part].astype(np.float64)
        content["kind"] = content["kind"].astype(np.int64)
        obstacles = no_obstacles(*content["kind"].shape)
        obstacles = obstacles._replace(**{part: content[part] for part in ("kind", *OBSTACLE_PARTS)})
        frozen = FrozenScenes(
            name=name or str(path),
            task=json.loads(str(content["task"])),
            scenes=Scenes(obstacles=obstacles, **{part: content[part] for part in SCENE_PARTS}),
            share=content["share"],
            family=content["family"],
        )
        intact = frozen.sha256 == str(content["sha256"])
    except Exception as error:  # an archive can be broken in any of its layers
        raise ValueError(f"{path} is not an .npz file of scenes: {error or type(error).__name__}") from None
    if not intact:
        raise ValueError(f"{path} is damaged: its content does not have the hash that it states")
    return frozen


def _smallest(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array in the smallest type that holds its values."""
    if array.dtype.kind == "f":
        single = array.astype(np.float32)
        same = (single.astype(np.float64) == array) | np.isnan(array)
        return single if same.all() else array
    return array.astype(np.int8) if array.dtype.kind == "i" else array


def drawn(name: str, task: Task, number: int) -> FrozenScenes:
    """Draw a set without shares; equal arguments give equal scenes."""
    generators = [np.random.default_rng((SEEDS[name], each)) for each in range(number)]
    scenes = task.sampler()(generators)
    share, family = np.full(number, np.nan), np.full(number, DRAWN)
    return FrozenScenes(name="drawn", task=task.as_dict(), scenes=scenes, share=share, family=family)


def scenes_for(given: str | Path | FrozenScenes, task: Task, number: int | None = None) -> FrozenScenes:
    """Return scenes of a set in SETS, of a file or of a record, evenly spread over it, up to a number.

    Where no frozen scenes are those of the task, they are drawn, and a line says so. A set that there is not, or scenes
    that cannot be those of the task, raise ValueError.
    """
    if isinstance(given, FrozenScenes) or str(given) not in SETS:
        own = given if isinstance(given, FrozenScenes) else load(Path(given).expanduser())
        _check_fit(own, task)
        scenes = own.scenes.with_rows(task.observation.n_rows)
        return dataclasses.replace(own, scenes=scenes).spread(number)
    name = str(given)
    frozen = shipped_set(name, task)
    if frozen is not None:
        return frozen.spread(number)
    if name not in SEEDS:
        raise ValueError(
            f"no {name} scenes are shipped for this task; scenes must be {', '.join(SEEDS)}, which are drawn for it, "
            "or a file"
        )
    print(f"no frozen {name} scenes are those of this task: they are drawn", file=sys.stderr)
    return drawn(name, task, NUMBERS[name] if number is None else number)


def _check_fit(frozen: FrozenScenes, task: Task) -> None:
    """Raise ValueError if the scenes of a file are none of a task."""
    there, rows = frozen.scenes.obstacles.kind, task.observation.n_rows
    kinds = {KINDS[kind] for kind in np.unique(there[there >= 0])}
    joints = frozen.scenes.start.shape[1]
    if joints != len(task.arm.joint_names) or there.shape[1] > rows or not kinds <= set(task.shapes):
        raise ValueError(
            f"{frozen.name} holds scenes of an arm of {joints} joints with up to {there.shape[1]} obstacles "
            f"({', '.join(sorted(kinds)) or 'none'}); the task has {len(task.arm.joint_names)} joints and up to {rows} "
            f"obstacles ({', '.join(task.shapes)})"
        )
    sensed = task.sensor is not None
    if sensed and (task.sampler().sensor_clearances(frozen.scenes) < VIEW_MARGIN).any():
        raise ValueError(f"{frozen.name} holds obstacles nearer than {VIEW_MARGIN} m to the sensor")
    changes = frozen.scenes.jumps, frozen.scenes.reach, frozen.scenes.turn_time < NEVER
    if task.whole_movement and any(part.any() for part in changes):
        raise ValueError(f"{frozen.name} holds scenes that change on the way, and the task has one decision")
    check_scenes(frozen.scenes, task.arm)
