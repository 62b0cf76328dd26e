"""Configurations of the commands, plain records that are checked when they are made, and presets of trainings."""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.registry import ARM_FILES, arm_of
from viapoint.envs.common.validation import is_number, number_of_at_least
from viapoint.envs.registration import ENV_IDS, check_registered, full_id
from viapoint.envs.task import Task
from viapoint.primitives.fitting import MOST_VIA_POINTS, USUAL_RANGE
from viapoint.training.checks import (
    DEFAULT_ENV,
    RANGES,
    SHIPPED_IDS,
    check_env_kwargs,
    check_file,
    check_folder,
    check_whole,
    named_path,
)
from viapoint.training.files import as_plain, folder_name, parse_yaml
from viapoint.training.planning.motion_plan import HIGHEST_RATE
from viapoint.training.planning.search import registered_task

REGISTRY = ConstructorRegistry()  # Ways in which the command line reads numbers and paths
# Types of values, and what errors call them
KINDS = {int: "a whole number", float: "a number", Path: "a path", str: "a text"}


@REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Return the form of a number, path or text, or of one of these or of a choice that may be left out."""
    kinds = set(get_args(info.type)) or {info.type}
    kind: Any = next((each for each in KINDS if each in kinds), None)  # a path before a text
    choices = next((get_args(each) for each in kinds if get_origin(each) is Literal), None)
    if choices is not None:  # tyro would list those that may be left out in random order
        kind = str
    elif kind is None or not kinds <= {NoneType, *KINDS}:
        return None

    def read(words: list[str]) -> Any:
        try:
            return named_path("it", words[0]) if kind is Path else kind(words[0])
        except ValueError:
            raise ValueError(f"must be {KINDS[kind]}, got {words[0]!r}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(choices) + "}" if choices else kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, kind),
        str_from_instance=lambda value: ["none" if value is None else str(value)],
        choices=choices,
    )


def from_words(words: list[str]) -> dict[str, Any]:
    """Return NAME=VALUE words as a dictionary; values are YAML."""
    values: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or not name:
            raise ValueError(f"must be NAME=VALUE, got {word!r}")
        if name in values:
            raise ValueError(f"{name} is there twice")
        values[name] = parse_yaml(text)
    return values


def to_words(values: Mapping[str, Any]) -> list[str]:
    """Return a dictionary as NAME=VALUE words; :func:`from_words` is the inverse."""
    return [f"{name}={json.dumps(value)}" for name, value in values.items()]


# tyro reads a dictionary of one type of values only.
NamedValues = Annotated[
    dict[str, Any],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="NAME=VALUE",
        instance_from_str=from_words,
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=to_words,
    ),
]
"""Dictionary that the command line writes as NAME=VALUE NAME=VALUE ..."""


def _listed(ids: Iterable[str]) -> str:
    """Return ids in few words for a help."""
    names = ", ".join(env_id.removeprefix("viapoint/").removesuffix("-v0") for env_id in ids)
    return f"viapoint/NAME-v0, where NAME is one of {names}"


ENV_HELP = f"Id of a registered environment: {_listed(ENV_IDS)}; or my_module:my/Task-v0."
ENV = tyro.conf.arg(metavar="ID", help=ENV_HELP)
ENV_OF_ARM = tyro.conf.arg(
    metavar="ID", help=ENV_HELP, help_behavior_hint=f"(default: {DEFAULT_ENV}, or one for --arm)"
)
AGENT = tyro.conf.arg(
    metavar="AGENT", help=f"Run folder, model folder, or id of a shipped agent: {_listed(SHIPPED_IDS)}."
)
ARM = tyro.conf.arg(metavar="ARM", help="Arm: panda, planar, or an MJCF or URDF file.")
# Environments of the built-in arms; that of other arms is viapoint/Obstacles-v0
ARM_ENVS = {"planar": DEFAULT_ENV, "panda": "viapoint/PandaObstacles-v0"}


def _plain(name: str, values: Any) -> Any:
    """Return values as JSON has them; a file of an arm is named by its whole path, as runs go on in other folders."""
    if not isinstance(values, Mapping):
        raise ValueError(f"{name} must be values by name, got {values!r}")
    try:
        plain = as_plain(values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from None
    arm, given = plain.get("arm"), values.get("arm")
    if isinstance(given, Arm) and not given.file and arm_of(arm) is not given:
        raise ValueError(f"{name}: arm {arm!r} must be made known by register_arm; another one has its name")
    if isinstance(arm, str) and arm.endswith(ARM_FILES):
        plain["arm"] = str(Path(arm).expanduser().resolve())
    return plain


def env_of_arm(arm: Arm | str | None, env: str | None) -> tuple[str | None, dict[str, Any]]:
    """Return the id of an environment for an arm, by default one with obstacles, and the argument for the arm."""
    if arm is None:
        return env, {}
    if env is None and arm in ARM_ENVS:
        return ARM_ENVS[arm], {}
    found = arm_of(arm)  # a file that cannot be loaded is told here
    return env or "viapoint/Obstacles-v0", {"arm": found if isinstance(arm, Arm) else found.file or arm}


def task_with(env_id: str, env_kwargs: Mapping[str, Any]) -> Task:
    """Return the task of an environment with arguments; an unknown or wrong one raises ValueError."""
    try:
        return registered_task(env_id, **env_kwargs)
    except TypeError as error:
        raise ValueError(f"env_kwargs of {env_id}: {error}") from error


Algorithm = Literal["viaq", "viarank", "sac", "td3", "ppo", "tqc"]
JOINT_DECISIONS = 16_000  # Most decisions in joint space, where one costs several times as much


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Default settings of an algorithm."""

    policy: str = "MultiInputPolicy"  # Name of the policy
    n_envs: int = 64  # Environments that are stepped together
    n_timesteps: int  # Decisions in total
    eval_every: int = 1_000  # Decisions between two evaluations on the validation scenes
    checkpoint_every: int = 5_000  # Decisions between two checkpoints
    hyperparameters: Mapping[str, Any]  # As :mod:`~.agents.model_io` writes them


# Settings by kinds of tasks, and algorithms
_SETTINGS = parse_yaml((files("viapoint.training") / "presets.yaml").read_bytes())


def _presets(kind: str) -> dict[str, Preset]:
    """Return the presets of a kind of tasks by the names of algorithms."""
    presets = {}
    for algo, fields in _SETTINGS[kind].items():
        presets[algo] = Preset(**fields)
    return presets


PRESETS = _presets("one decision")
STEP_PRESETS = _presets("control steps")
REACH_PRESETS = _presets("no obstacles")
REPLANNING_PRESETS = _presets("replanning")


def usual_algorithm(task: Task) -> Algorithm:
    """Return the algorithm that a task is trained with if none is named."""
    return "viaq" if task.sensor is None else "viarank"


def preset_of(task: Task, algo: Algorithm) -> Preset:
    """Return the default settings of an algorithm for a task."""
    if task.stepwise:
        return STEP_PRESETS[algo]
    preset = PRESETS[algo]
    if task.replanning:
        preset = REPLANNING_PRESETS.get(algo, preset)
    elif not task.n_obstacles[1]:
        preset = REACH_PRESETS.get(algo, preset)
    if task.space.of_hand or algo not in ("viaq", "viarank"):
        return preset
    settings = dict(_SETTINGS["joint space"].get(algo, {}))
    if settings and task.replanning:  # movements under way are not refined
        settings["policy_kwargs"] = {**settings["policy_kwargs"], "refine": 0}
    fewer = min(preset.n_timesteps, JOINT_DECISIONS)
    return dataclasses.replace(
        preset, n_timesteps=fewer, hyperparameters={**preset.hyperparameters, **settings}
    )


Format = Literal["table", "md", "csv", "json"]  # Form of a table
BENCHMARK = "motionbenchmaker"  # Name of the scene set that measures planners
MOTION_FILES = (".csv", ".yaml", ".yml")  # Suffixes of files of movements
USUAL_BASELINES = ("straight", "random", "search512")  # Baselines of an evaluation


@dataclass(frozen=True, kw_only=True)
class Config:
    """Configuration of a command; paths may be given as strings."""

    def __post_init__(self) -> None:
        """Check the values."""
        for each in dataclasses.fields(self):
            name, value = each.name, getattr(self, each.name)
            if "Path" in str(each.type) and "tuple" not in str(each.type) and value is not None:
                value = named_path(name, value)
            elif str(each.type) == "bool" and not isinstance(value, bool):
                raise ValueError(f"{name} must be True or False, got {value!r}")
            elif name == "env" and isinstance(value, str) and value != each.default:
                value = check_registered(value)
            elif str(each.type) == "NamedValues":
                value = _plain(name, value)
                if name == "env_kwargs":
                    check_env_kwargs(value)
            elif name in RANGES and value is not each.default and not isinstance(value, tuple | list):
                value = check_whole(name, value)
            object.__setattr__(self, name, value)
        self._check()

    def _check(self) -> None:
        """Check what is not a whole number or a path."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Config):
    """Train an agent.

    Example: viapoint train --env viapoint/PlanarObstacles-v0 --n-timesteps 10000 --out runs/first

    Example:
        >>> from viapoint.training import TrainConfig
        >>> config = TrainConfig(env="viapoint/PandaObstacles-v0", seed=1, hyperparameters={"batch_size": 128})
        >>> config.folder.as_posix(), config.total_timesteps
        ('runs/PandaObstacles-v0-viaq-1', 16000)
    """

    env: Annotated[str, ENV_OF_ARM] = ""
    """Id of the environment; by default viapoint/PlanarObstacles-v0, or with `arm` one for this arm."""
    arm: Annotated[str | None, ARM] = None
    """Arm, which becomes one of the arguments of the environment; the usual environment is then one for any arm."""
    algo: Algorithm | None = None
    """Learning algorithm; default: viaq, or viarank where obstacles are seen with a sensor."""
    seed: int = 0  #: Seed of all random numbers.
    n_timesteps: int | None = None  #: Decisions, in whole rounds of all environments; default: the preset's.
    stop_when_stalled: float | None = None  #: Stop if success stalls for this share of decisions.
    n_envs: int | None = None  #: Environments stepped together; default: the preset's.
    out: Path | str | None = None  #: Run folder; default: runs/<environment>-<algorithm>-<seed>.
    resume: bool = False
    """Continue the run from its last checkpoint; --n-timesteps may extend it, others must be as they were."""
    eval_every: int | None = None  #: Decisions between evaluations, 0 for none; default: the preset's.
    eval_scenes: int = 500  #: Validation scenes in each evaluation.
    checkpoint_every: int | None = None  #: Decisions between checkpoints; default: the preset's.
    env_kwargs: NamedValues = field(default_factory=dict)
    """Arguments of the environment, values in YAML: n_via=2 timing=learned whole_arm=true n_obstacles=[1,8]."""
    hyperparameters: NamedValues = field(default_factory=dict)
    """Hyperparameters that replace those of the preset, in the same form: batch_size=256."""
    progress: bool = True  #: Show a progress bar.

    def _check(self) -> None:
        if not isinstance(self.env, str):
            raise ValueError(f"env must be the id of an environment, got {self.env!r}")
        if self.algo is not None and self.algo not in get_args(Algorithm):
            raise ValueError(f"algo must be one of {', '.join(get_args(Algorithm))}, got {self.algo!r}")
        if self.arm is not None or not self.env:
            env, argument = env_of_arm(self.arm or "planar", self.env or None)
            object.__setattr__(self, "env", env)
            object.__setattr__(self, "env_kwargs", {**self.env_kwargs, **_plain("arm", argument)})
            object.__setattr__(self, "arm", None)
        if self.algo is None:
            object.__setattr__(self, "algo", usual_algorithm(self.task))
        if self.task.stepwise and self.algo not in STEP_PRESETS:
            known = ", ".join(STEP_PRESETS)
            raise ValueError(f"{self.algo} decides on whole movements; algo for {self.env} is one of {known}")
        if self.algo in ("viaq", "viarank") and self.algo != usual_algorithm(self.task):
            raise ValueError(f"no {self.algo} for {self.env}: viaq needs the obstacles, and viarank a sensor")
        share = self.stop_when_stalled
        if share is None:
            return
        least = self.preset.n_timesteps  # before which a training does not stall
        if not is_number(share) or not 0.0 < share < 1.0:
            raise ValueError(f"stop_when_stalled must be a number over 0 and below 1, got {share!r}")
        if not self.evaluation_interval:
            raise ValueError("stop_when_stalled needs validations: eval_every must be 1 or more, got 0")
        if self.total_timesteps <= least:
            raise ValueError(f"stop_when_stalled needs n_timesteps over {least}, got {self.total_timesteps}")

    @functools.cached_property
    def task(self) -> Task:
        """Task of the environment; an unknown or wrong argument of it raises ValueError."""
        return task_with(self.env, self.env_kwargs)

    @property
    def algorithm(self) -> Algorithm:
        """Learning algorithm, also where none is named."""
        return self.algo or usual_algorithm(self.task)

    @property
    def preset(self) -> Preset:
        """Settings for everything that is not given."""
        return preset_of(self.task, self.algorithm)

    @property
    def resolved(self) -> TrainConfig:
        """Configuration in which the values of the preset replace None, as a run stores it.

        A short training begins to learn sooner in proportion.
        """
        usual = dict(self.preset.hyperparameters)
        if "learning_starts" in usual:
            share = min(1.0, self.total_timesteps / self.preset.n_timesteps)
            usual["learning_starts"] = round(share * usual["learning_starts"])
        return dataclasses.replace(
            self,
            n_timesteps=self.total_timesteps,
            n_envs=self.n_envs or self.preset.n_envs,
            eval_every=self.evaluation_interval,
            checkpoint_every=self.checkpoint_every or self.preset.checkpoint_every,
            hyperparameters={**usual, **self.hyperparameters},
        )

    @property
    def total_timesteps(self) -> int:
        """Decisions in total."""
        return self.n_timesteps or self.preset.n_timesteps

    @property
    def evaluation_interval(self) -> int:
        """Decisions between two evaluations, 0 for none."""
        return self.preset.eval_every if self.eval_every is None else self.eval_every

    @property
    def command(self) -> str:
        """Command that trains with this configuration, apart from where it is written and what is shown."""
        words = ["viapoint", "train"]
        for name in ("env", "algo", "seed", "n_timesteps", "n_envs", "env_kwargs", "hyperparameters"):
            value = full_id(self.env) if name == "env" else getattr(self, name)
            if value not in (None, {}):
                given = to_words(value) if isinstance(value, dict) else [str(value)]
                words += [f"--{name.replace('_', '-')}", *given]
        return shlex.join(words)

    @property
    def folder(self) -> Path:
        """Run folder."""
        usual = Path("runs") / f"{folder_name(self.env)}-{self.algo}-{self.seed}"
        return Path(self.out) if self.out else usual


@dataclass(frozen=True, kw_only=True)
class AgentConfig(Config):
    """Configuration of a command for an agent, an environment or an arm."""

    agent: Annotated[tyro.conf.Positional[str | None], AGENT] = None
    env: Annotated[str | None, ENV] = None  # default: that of the agent
    arm: Annotated[str | None, ARM] = None  # in place of that of the agent, if any
    env_kwargs: NamedValues = field(default_factory=dict)
    """Arguments of the environment, values in YAML: sensor=hand_rays decide_at=[sight]."""


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(AgentConfig):
    """Evaluate an agent and baselines on the same scenes.

    Example: viapoint evaluate viapoint/PlanarObstacles-v0 --baselines straight search512 --n-scenes 100
    """

    baselines: tuple[str, ...] = USUAL_BASELINES
    """Some of straight, random, plan_motion, ompl, search512 or another number (the best of that many computed plans),
    sobol512 (of fixed plans); with an agent, untrained (its network before training); with a sensor, cautious512,
    deep:plan_motion, and points:, thick:, fitted:, seen: or known: before a planner; with moving obstacles, rest:,
    reach: or known: before searchN."""
    checks: tuple[int, ...] = (0,)
    """Numbers of proposals that the agent checks with exact geometry, one row of the table each; 0 for none."""
    refine: tuple[int, ...] = ()  # Numbers of proposals that the planner refines, one further row each.
    scenes: str = "test"
    """Scene set: validation, test, hard, uniform, or an .npz file of scenes; motionbenchmaker for the problems of that
    benchmark, on which planners are measured: straight, plan_motion, paths, plan_motion+ompl, ompl, search512."""
    problems: Path | None = None
    """Folder of MotionBenchMaker's own files, in place of the problems that are shipped; with --arm, for the joints of
    that arm, by their names."""
    n_scenes: int | None = None  # Number of scenes, evenly spread over the set; all if not given.
    format: Format = "table"  # Form in which the table is printed: for the terminal, Markdown, CSV or JSON.
    json: Path | None = None  # JSON file for all results, scene by scene.

    @property
    def of_planners(self) -> bool:
        """True if planners are measured on the problems of MotionBenchMaker."""
        return self.problems is not None or self.scenes == BENCHMARK

    def _check(self) -> None:
        if self.of_planners and not (self.agent is self.env is None):
            raise ValueError(f"{BENCHMARK} measures planners: name neither an agent nor an environment")
        if self.of_planners and self.arm is not None and self.problems is None:
            raise ValueError("the problems that are shipped are for one arm; --arm needs --problems")
        if self.problems is not None and self.scenes not in ("test", BENCHMARK):
            raise ValueError(f"name a scene set or a folder of problems, not both: got {self.scenes!r}")
        if self.of_planners and not self.baselines:
            raise ValueError("baselines must name at least one planner")
        if not self.checks:
            raise ValueError("checks must name at least one number, such as 0")
        if (any(self.checks) or self.refine) and self.agent is None:
            raise ValueError("checks and refine concern an agent, and none is given")
        check_file("json", self.json)


@dataclass(frozen=True, kw_only=True)
class PlayConfig(AgentConfig):
    """Record a video of an agent's movements.

    Without an agent, the movements are those of search512.

    Example: viapoint play viapoint/PlanarObstacles-v0 --video movements.mp4 --scenes hard
    """

    video: Path = Path("movements.mp4")  # MP4 file to write.
    scenes: str = "test"  # Scene set: validation, test, hard, uniform, or an .npz file.
    n_scenes: int = 8  # Number of scenes, evenly spread over the set.
    checks: int = 0  # Number of proposals that the agent checks with exact geometry; 0 for none.

    def _check(self) -> None:
        if self.agent is None and self.checks:
            raise ValueError("checks concern an agent, and none is given")
        check_file("video", self.video, ".mp4")


@dataclass(frozen=True, kw_only=True)
class RecordConfig(AgentConfig):
    """Record episodes as a Minari dataset for offline learning.

    The method is an agent, or a baseline such as random or search512 in the environment of --env or --arm.

    Example: viapoint record search512 --env viapoint/PlanarObstacles-v0 --episodes 100 --dataset planar/search-v0
    """

    episodes: int = 100  # Number of episodes.
    dataset: str | None = None
    """Name of the dataset; default: <environment>/<method>-v0, in the folder MINARI_DATASETS_PATH."""
    seed: int = 0  # Seed of the first episode; others follow.

    def _check(self) -> None:
        if self.agent is None:
            raise ValueError("name an agent (run folder, model folder or id), or a baseline such as random")


@dataclass(frozen=True, kw_only=True)
class PlanConfig(Config):
    """Plan a smooth movement of an arm around known obstacles.

    With --arm alone, the joints, limits, tool and home of the arm are printed.

    Example: viapoint plan --arm panda --position 0.5 0.3 0.4 --out plan.csv
    """

    arm: Annotated[str, ARM] = "panda"
    start: tuple[float, ...] = ()
    """Joint positions at the start, [rad]; by default those of the scene file, or home."""
    goal: tuple[float, ...] = ()  # Joint positions at the goal, [rad]; by default those of the scene file.
    position: tuple[float, ...] = ()
    """Place of the tool at the goal, x y z, [m], in place of joint positions."""
    quaternion: tuple[float, ...] = ()  # Orientation of the tool there, w x y z; any if not given.
    scene: Path | None = None  # JSON file of a scene, or of a list of obstacles.
    tool: str = ""
    """Site or body of the tool of an arm of a file; by default one with a usual name, or the tip."""
    joints: tuple[str, ...] = ()
    """Names of its joints from the base to the tool; by default all of the chain."""
    base: str = ""  # Body that the chain begins at, where a file has two arms.
    packages: tuple[Path, ...] = ()  # Folders for package:// in a URDF.
    velocity_limit: float | None = None  # Velocity limit of joints, [rad/s], slides [m/s]; else the file's.
    torque_limit: float | None = None  # Torque limit of joints, [N m], slides [N]; else the file's.
    n_via: int = 2  # Number of via-points, 1 to 3.
    margin: float = 0.0  # Least clearance, [m].
    duration: float | None = None  # Duration, [s]; by default the shortest that the limits allow.
    time_limit: float = 1.0  # Time after which no further seed is tried, [s].
    rate: float = 100.0  # Instants per second of the file, [Hz].
    out: Path | None = None
    """File to write: .csv, or .yaml for a message trajectory_msgs/JointTrajectory of ROS 2."""
    video: Path | None = None  # MP4 file to write.
    seed: int = 0  # Seed of the random numbers.
    force: bool = False  # True to write plans that touch something, too.

    def _check(self) -> None:
        check_file("video", self.video, ".mp4")
        if self.out is not None:
            if self.out.suffix.lower() not in MOTION_FILES:
                raise ValueError(f"out must end in {' or '.join(MOTION_FILES)}, got {self.out}")
            check_folder(f"out {self.out}", self.out.parent)
        if self.goal and self.position:
            raise ValueError("a goal is either --goal, joint positions, or --position; both are given")
        number_of_at_least("rate", self.rate, 1e-3, HIGHEST_RATE)
        if self.quaternion and not self.position:
            raise ValueError("--quaternion belongs to --position, the place of the tool at the goal")


@dataclass(frozen=True, kw_only=True)
class FitConfig(Config):
    """Fit via-points to measured movements.

    The file is a CSV with the columns time, x, y, and optionally z and movement.

    Example: viapoint fit movements.csv --n-via 1 --out fit
    """

    file: tyro.conf.Positional[Path]  # CSV file with one sample in each line, [s] and [m].
    n_via: tuple[int, ...] = USUAL_RANGE  # Number of via-points, or the fewest and the most to choose among.
    free_ends: bool = True
    """Fit onset and end, too; otherwise a movement begins with its first sample and ends with its last."""
    out: Path = Path("fit")  # Folder for the table fit.csv and the figure fit.png.

    @property
    def numbers(self) -> tuple[int, int]:
        """Fewest and most via-points."""
        return self.n_via[0], self.n_via[-1]

    def _check(self) -> None:
        if len(self.n_via) not in (1, 2) or not 0 <= self.n_via[0] <= self.n_via[-1] <= MOST_VIA_POINTS:
            allowed = f"one number, or the fewest and the most, from 0 to {MOST_VIA_POINTS}"
            raise ValueError(f"n_via must be {allowed}, got {self.n_via}")
        check_folder(f"out {self.out}", self.out)


@dataclass(frozen=True, kw_only=True)
class LiveConfig(AgentConfig):
    """Serve a page in the browser on which goal and obstacles are dragged.

    Example: viapoint live --arm panda
    """

    port: int = 8080  # Port to listen on; 0 for a free one.
    seed: int | None = None  # Seed of the random scenes.


@dataclass(frozen=True, kw_only=True)
class PaperConfig(Config):
    """Reproduce the claims and figures of Flash & Hogan 1985.

    Example: viapoint paper --out paper
    """

    out: Path = Path("paper")  # Folder for the figures and the table.
    agent: Path | None = None
    """Run folder or model folder of an agent that moves around the rows of lights; default: the geometry search."""

    def _check(self) -> None:
        check_folder(f"out {self.out}", self.out)


@dataclass(frozen=True, kw_only=True)
class DemoConfig(Config):
    """Train an agent, evaluate it, draw and film it.

    Example: viapoint demo --out runs/demo
    """

    out: Path = Path("runs/demo")  # Folder for all files; existing results are kept.
    env: Annotated[str, ENV] = DEFAULT_ENV  # Id of the environment.
    n_timesteps: int | None = None  # Decisions in total; default: a quarter of those of the preset.
    n_scenes: int | None = None  # Number of test scenes, evenly spread over the set; all if not given.

    def _check(self) -> None:
        if not registered_task(self.env).whole_movement:
            raise ValueError(f"env must have whole movements as actions, as {DEFAULT_ENV}, got {self.env!r}")
        check_folder(f"out {self.out}", self.out)


class DoctorConfig(Config):
    """Check what works on this machine, and name what to install.

    Example: viapoint doctor
    """


@dataclass(frozen=True, kw_only=True)
class StudyConfig(Config):
    """Run the trainings, baselines and searches of a YAML file.

    The same command continues a study that was stopped, and does what was added to its file.

    Example: echo '{environments: [viapoint/PlanarReach-v0], baselines: [straight]}' > a.yaml; viapoint study a.yaml
    """

    file: tyro.conf.Positional[Path]  # YAML file that describes the study (docs/studies.md).
    out: Path | None = None
    """Folder of runs and results; default: the one in the file, or runs/<name of the file>."""
    workers: int | None = None
    """Number of trials at the same time on this machine; default: as many as the cores allow."""
