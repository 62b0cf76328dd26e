"""What the commands can be told: plain records, checked when made, that become the command line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

import tyro

from viapoint.envs.registration import STEP_TASKS
from viapoint.training.config.checks import (
    DEFAULT_ENV,
    check_baselines,
    check_env,
    check_env_kwargs,
    check_file,
    check_folder,
    check_has_scenes,
    check_hyperparameters,
    check_whole,
    check_whole_movements,
)
from viapoint.training.config.discount import check_discount_unit
from viapoint.training.config.key_values import NamedValues
from viapoint.training.config.presets import STEP_PRESETS, Algorithm, Preset, preset_of


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train an agent.

    Example: viapoint train --env viapoint/PlanarObstacles-v0 --algo viaq --seed 0 --out runs/first
    """

    env: str = DEFAULT_ENV
    """Id of the environment; an unknown one is answered with all that there are."""
    algo: Algorithm = "viaq"
    """Learning algorithm; training/config/presets.py holds the settings of each."""
    seed: int = 0
    """Seed of everything that is random: equal seeds give equal agents on one machine."""
    n_timesteps: int | None = None
    """Decisions in all; as the preset says if not given."""
    n_envs: int | None = None
    """Environments stepped together; as the preset says if not given."""
    out: Path | None = None
    """Run folder; runs/<environment>-<algorithm>-<seed> if not given."""
    resume: bool = False
    """Go on with the run in the folder from its last checkpoint, with its own configuration; --n-timesteps may extend
    it, other flags must be those that it began with."""
    eval_every: int | None = None
    """Decisions between two evaluations on the validation scenes, 0 for none; as the preset says if not given."""
    eval_scenes: int = 500
    """Validation scenes used in each evaluation, at most."""
    checkpoint_every: int | None = None
    """Decisions between two checkpoints; as the preset says if not given."""
    env_kwargs: NamedValues = field(default_factory=dict)
    """Arguments of the environment, words or JSON: n_via=2 timing=learned whole_arm=true n_obstacles=[1,8]."""
    hyperparameters: NamedValues = field(default_factory=dict)
    """Settings of the algorithm in place of its preset's, in the same form: batch_size=256."""
    discount_unit: float | None = None
    """Seconds that are discounted by gamma once, where decisions differ in length and the environment tells it; as
    the preset says if not given."""
    progress: bool = True
    """Whether to show a progress bar."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_env(self.env)
        if self.algo not in get_args(Algorithm):
            raise ValueError(f"algo must be one of {', '.join(get_args(Algorithm))}, got {self.algo!r}")
        if self.env in STEP_TASKS and self.algo not in STEP_PRESETS:
            raise ValueError(
                f"{self.algo} decides on whole movements; for {self.env} algo must be one of "
                f"{', '.join(STEP_PRESETS)}"
            )
        for name, least in (("seed", 0), ("eval_scenes", 1)):
            check_whole(name, getattr(self, name), least)
        for name, least in (("n_timesteps", 1), ("n_envs", 1), ("eval_every", 0), ("checkpoint_every", 1)):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), least)
        check_env_kwargs(self.env_kwargs)
        check_hyperparameters(self.algo, self.hyperparameters)
        if self.discount_unit is not None:
            check_discount_unit(self.algo, self.discount_unit, self.env)

    @property
    def preset(self) -> Preset:
        """What holds for everything that is not given."""
        return preset_of(self.env, self.algo)

    @property
    def total_timesteps(self) -> int:
        """Decisions in all."""
        return self.n_timesteps or self.preset.n_timesteps

    @property
    def copies(self) -> int:
        """Environments stepped together."""
        return self.n_envs or self.preset.n_envs

    @property
    def evaluation_interval(self) -> int:
        """Decisions between two evaluations, 0 for none."""
        return self.preset.eval_every if self.eval_every is None else self.eval_every

    @property
    def checkpoint_interval(self) -> int:
        """Decisions between two checkpoints."""
        return self.checkpoint_every or self.preset.checkpoint_every

    @property
    def time_unit(self) -> float | None:
        """Seconds that count gamma; None where each decision does, whatever it takes."""
        return self.preset.discount_unit if self.discount_unit is None else self.discount_unit

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self.out or Path("runs") / f"{self.env.rpartition('/')[2]}-{self.algo}-{self.seed}"


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Evaluate an agent and baselines on the same scenes.

    Example: viapoint evaluate runs/first --baselines straight planner --scenes test
    """

    agent: tyro.conf.Positional[str | None] = None
    """Run folder, model folder, or id of an environment with a shipped agent; baselines alone if not given."""
    baselines: tuple[str, ...] = ("straight", "random", "planner")
    """Some of straight, constant, random, random16, random80, planner, ompl, search16, search64, search512 and
    search4096 (the best of that many computed plans); with an agent, untrained (its network before training); in tasks
    with replanning, unrevised (the first plan alone)."""
    checks: tuple[int, ...] = (0,)
    """Numbers of proposals that the agent checks with exact geometry, one row of the table each; 0 for none."""
    scenes: str = "test"
    """validation, test, hard, or a file of scenes."""
    n_scenes: int | None = None
    """Only the first so many scenes; all if not given."""
    json: Path | None = None
    """File for all results, scene by scene, as JSON."""
    failures: Path | None = None
    """Folder for counts and pictures of the agent's failures by kind; those of its last row in the table."""
    env: str | None = None
    """Id of the environment; that of the agent if not given."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_baselines(self.baselines)
        if self.env is not None:
            check_env(self.env)
        if self.agent is None and self.env is None:
            raise ValueError("name an agent (run folder, model folder or id), or an environment with --env")
        for number in self.checks:
            check_whole("checks", number, 0)
        if not self.checks:
            raise ValueError("checks must name at least one number, such as 0")
        if self.n_scenes is not None:
            check_whole("n_scenes", self.n_scenes, 1)
        check_file("json", self.json)
        check_folder("failures", self.failures)
        for name, asked in (("checks", any(self.checks)), ("failures", self.failures is not None)):
            if asked and self.agent is None:
                raise ValueError(f"{name} concerns an agent, and none is given")


@dataclass(frozen=True, kw_only=True)
class PlayConfig:
    """Record a video of an agent's movements.

    Example: viapoint play runs/first --video movements.mp4 --scenes hard
    """

    agent: tyro.conf.Positional[str]
    """Run folder, model folder, or id of an environment with a shipped agent."""
    video: Path = Path("movements.mp4")
    """File to write, an MP4."""
    scenes: str = "test"
    """validation, test, hard, or a file of scenes."""
    n_scenes: int = 8
    """How many of them, evenly spread over the set."""
    checks: int = 0
    """How many of the agent's proposals are checked by exact geometry; 0 for none."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_file("video", self.video, ".mp4")
        check_whole("n_scenes", self.n_scenes, 1)
        check_whole("checks", self.checks, 0)


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """Measure throughput as ratios to what the engine alone and a plain copy would take.

    Example: viapoint bench --json bench.json
    """

    env: str = DEFAULT_ENV
    """Id of the environment."""
    num_envs: int = 512
    """Environments in the batch."""
    repeats: int = 9
    """Measurements of each side, of which the fastest counts; they alternate."""
    json: Path | None = None
    """File for the figures."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_env(self.env)
        check_whole_movements(self.env)
        check_whole("num_envs", self.num_envs, 1)
        check_whole("repeats", self.repeats, 1)
        check_file("json", self.json)


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """Reproduce Flash & Hogan 1985: every claim as a number, every figure, on the model and on the simulated arm.

    Example: viapoint paper --out paper
    """

    out: Path = Path("paper")
    """Folder for the figures and the table."""
    agent: Path | None = None
    """Run folder of the agent that goes around the rows of lights; the shipped one, or the planner, if not given."""
    guide: Path | None = None
    """Folder for the small pictures of docs/flash-hogan.md."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_folder("out", self.out)
        check_folder("guide", self.guide)


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """Train, evaluate, draw and film an agent: everything in one folder.

    Example: viapoint demo --out runs/demo
    """

    out: Path = Path("runs/demo")
    """Folder for everything; what is there already is kept."""
    env: str = DEFAULT_ENV
    """Id of the environment."""
    seed: int = 0
    """Seed of the training."""
    n_timesteps: int | None = None
    """Decisions to train for; a quarter of those of the preset if not given, so that nobody waits for long."""
    n_scenes: int | None = None
    """Test scenes to evaluate on; all if not given."""
    checks: int = 16
    """How many of the agent's proposals are checked by exact geometry in its second row of the table."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_env(self.env)
        check_whole_movements(self.env)
        check_has_scenes(self.env)
        check_folder("out", self.out)
        check_whole("seed", self.seed, 0)
        check_whole("checks", self.checks, 1)
        for name in ("n_timesteps", "n_scenes"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), 1)

    @property
    def total_timesteps(self) -> int:
        """Decisions of a training that begins."""
        return self.n_timesteps or TrainConfig(env=self.env).total_timesteps // 4


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """Tell what works on this machine, and what to install where something does not.

    Example: viapoint doctor
    """

    out: Path = Path("runs")
    """Folder that runs are to be written to."""
    json: bool = False
    """Whether to print JSON for programs instead of lines for people."""


@dataclass(frozen=True, kw_only=True)
class ImportConfig:
    """Turn an archive of Stable-Baselines3 into a model of tensors and JSON. Opening such an archive runs its code.

    Example: viapoint import-sb3 model.zip --env viapoint/PlanarObstacles-v0 --out models/mine --trust
    """

    file: tyro.conf.Positional[Path]
    """The archive that SB3's `model.save` wrote."""
    env: str = DEFAULT_ENV
    """Id of the environment that the model was trained on, with default arguments."""
    out: Path
    """Folder for the model; must be new."""
    algo: Literal["sac", "td3", "ppo", "tqc"] | None = None
    """Its algorithm; recognised from the archive if not given."""
    trust: bool = False
    """Open it without asking: you know where it comes from."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        check_env(self.env)
        check_folder("out", self.out)
