"""Configurations of the commands: plain records that are checked when they are made."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, get_args

import tyro

from viapoint.envs.registration import ENV_IDS, STEP_TASKS
from viapoint.training.config.base import Config
from viapoint.training.config.checks import (
    DEFAULT_ENV,
    SHIPPED_IDS,
    check_baselines,
    check_env,
    check_env_kwargs,
    check_file,
    check_folder,
    check_has_scenes,
    check_hyperparameters,
    check_observed,
    check_rollout_workers,
    check_stalling,
    check_whole,
    check_whole_movements,
)
from viapoint.training.config.discount import check_discount_unit
from viapoint.training.config.key_values import NamedValues, to_words
from viapoint.training.config.presets import STEP_PRESETS, Algorithm, Preset, preset_of

ENV = tyro.conf.arg(metavar="ID", help=f"Id of the environment, one of {', '.join(ENV_IDS)}.")
AGENT = tyro.conf.arg(
    metavar="AGENT",
    help=f"Run folder, model folder, or id of an environment with a shipped agent: {', '.join(SHIPPED_IDS)}.",
)
PRETRAINED = tyro.conf.arg(metavar="ID", help=f"Shipped agent, one of {', '.join(SHIPPED_IDS)}.")
EnvId = Annotated[str, ENV]
"""Id of an environment; the help of a command lists them."""

if TYPE_CHECKING:
    AnyPath = str | Path
else:
    AnyPath = Path  # the command line makes paths of words


@dataclass(frozen=True, kw_only=True)
class TrainConfig(Config):
    """Train an agent.

    Example: viapoint train --env viapoint/PlanarObstacles-v0 --algo viaq --seed 0 --out runs/first

    Raises:
        ValueError: A value is not allowed; the message lists the allowed values.

    Example:
        >>> from viapoint.training import TrainConfig
        >>> config = TrainConfig(env="viapoint/PandaObstacles-v0", seed=1, hyperparameters={"batch_size": 128})
        >>> config.folder.as_posix(), config.total_timesteps
        ('runs/PandaObstacles-v0-viaq-1', 40000)
    """

    least: ClassVar = dict.fromkeys(
        ("seed", "eval_every", "observe_candidates", "rollout_workers"), 0
    ) | dict.fromkeys(("n_timesteps", "min_timesteps", "n_envs", "eval_scenes", "checkpoint_every"), 1)

    env: EnvId = DEFAULT_ENV
    """Id of the environment."""
    algo: Algorithm = "viaq"
    """Learning algorithm."""
    seed: int = 0
    """Seed of all random numbers."""
    n_timesteps: int | None = None
    """Decisions; default: the preset's."""
    stop_when_stalled: float | None = None
    """Stop if success stalls for this share of decisions."""
    min_timesteps: int | None = None
    """Decisions before it may stop; default: the preset's."""
    n_envs: int | None = None
    """Environments stepped together; default: the preset's."""
    out: AnyPath | None = None
    """Run folder; default: runs/<environment>-<algorithm>-<seed>."""
    resume: bool = False
    """Continue the run from its last checkpoint; --n-timesteps may extend it, others must be as they were."""
    eval_every: int | None = None
    """Decisions between evaluations, 0 for none; default: the preset's."""
    eval_scenes: int = 500
    """Validation scenes in each evaluation."""
    checkpoint_every: int | None = None
    """Decisions between checkpoints; default: the preset's."""
    observe_candidates: int = 0
    """Plans whose clearance is observed; not for viaq."""
    env_kwargs: NamedValues = field(default_factory=dict)
    """Arguments of the environment, words or JSON: n_via=2 timing=learned whole_arm=true n_obstacles=[1,8]."""
    hyperparameters: NamedValues = field(default_factory=dict)
    """Hyperparameters that replace those of the preset, in the same form: batch_size=256."""
    discount_unit: float | None = None
    """Time that gamma discounts once, [s]; default: that of the preset."""
    progress: bool = True
    """Show a progress bar."""
    rollout_workers: int = 0
    """Processes that share the environments, 0 for none."""
    on: str = "local"
    """Place of rollout workers: local, ray or ray://HOST:PORT."""

    def _check(self) -> None:
        check_env(self.env)
        if self.algo not in get_args(Algorithm):
            raise ValueError(f"algo must be one of {', '.join(get_args(Algorithm))}, got {self.algo!r}")
        if self.env in STEP_TASKS and self.algo not in STEP_PRESETS:
            raise ValueError(
                f"{self.algo} decides on whole movements; for {self.env} algo must be one of "
                f"{', '.join(STEP_PRESETS)}"
            )
        check_observed(self.observe_candidates, self.algo, self.env)
        check_env_kwargs(self.env_kwargs)
        check_rollout_workers(self.rollout_workers, self.on, None if self.resume else self.copies)
        check_hyperparameters(self.algo, self.hyperparameters)
        if self.discount_unit is not None:
            check_discount_unit(self.algo, self.discount_unit, self.env)
        limits = self.least_timesteps, self.total_timesteps
        check_stalling(self.stop_when_stalled, self.min_timesteps, self.evaluation_interval, limits)

    @property
    def preset(self) -> Preset:
        """Settings for everything that is not given."""
        return preset_of(self.env, self.algo)

    @property
    def total_timesteps(self) -> int:
        """Decisions in total."""
        return self.n_timesteps or self.preset.n_timesteps

    @property
    def least_timesteps(self) -> int:
        """Decisions before which a stalled training goes on."""
        return self.min_timesteps or self.preset.n_timesteps

    @property
    def copies(self) -> int:
        """Environments that are stepped together."""
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
        """Time after which gamma discounts once, [s]; None if each decision is discounted once."""
        return self.preset.discount_unit if self.discount_unit is None else self.discount_unit

    @property
    def command(self) -> str:
        """Command that trains with this configuration, apart from where it is written and what is shown."""
        words = ["viapoint", "train"]
        for name in ("env", "algo", "seed", "n_timesteps", "n_envs", "discount_unit"):
            value = getattr(self, name)
            if value is not None:
                words += [f"--{name.replace('_', '-')}", f"{value}"]
        for name in ("env_kwargs", "hyperparameters"):
            values = getattr(self, name)
            if values:
                words += [f"--{name.replace('_', '-')}", *to_words(values)]
        return shlex.join(words)

    @property
    def folder(self) -> Path:
        """Run folder."""
        usual = Path("runs") / f"{self.env.rpartition('/')[2]}-{self.algo}-{self.seed}"
        return Path(self.out) if self.out else usual


@dataclass(frozen=True, kw_only=True)
class AgentConfig(Config):
    """Configuration of a command for one agent."""

    agent: Annotated[tyro.conf.Positional[str | None], AGENT] = None
    """Run folder, model folder, or id of an environment with a shipped agent."""
    pretrained: Annotated[str | None, PRETRAINED] = None
    """Id of an environment: its shipped agent, as if the id were given as AGENT."""

    def _check(self) -> None:
        if self.pretrained is None:
            return
        if self.agent not in (None, self.pretrained):
            raise ValueError(f"the agent is named twice: {self.agent} and pretrained={self.pretrained}")
        if self.pretrained not in SHIPPED_IDS:
            raise ValueError(f"pretrained must be one of {', '.join(SHIPPED_IDS)}, got {self.pretrained!r}")
        object.__setattr__(self, "agent", self.pretrained)


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(AgentConfig):
    """Evaluate an agent and baselines on the same scenes.

    Example: viapoint evaluate runs/first --baselines straight planner --scenes test
    """

    baselines: tuple[str, ...] = ("straight", "random", "planner")
    """Some of straight, constant, random, random16, random80, planner, ompl, search16, search64, search512 and
    search4096 (the best of that many computed plans); with an agent, untrained (its network before training); in tasks
    with replanning, unrevised (the first plan alone)."""
    checks: tuple[int, ...] = (0,)
    """Numbers of proposals that the agent checks with exact geometry, one row of the table each; 0 for none."""
    scenes: str = "test"
    """Scene set: validation, test, hard, uniform, or a scene file."""
    n_scenes: int | None = None
    """Number of scenes, evenly spread over the set; all if not given."""
    json: Path | None = None
    """JSON file for all results, scene by scene."""
    failures: Path | None = None
    """Folder for counts and pictures of the agent's failures by kind, those of its last row in the table."""
    env: Annotated[str | None, ENV] = None
    """Id of the environment; default: that of the agent."""

    least: ClassVar = {"n_scenes": 1}

    def _check(self) -> None:
        super()._check()
        check_baselines(self.baselines)
        if self.env is not None:
            check_env(self.env)
        if self.agent is None and self.env is None:
            raise ValueError("name an agent (run folder, model folder or id), or an environment with --env")
        for number in self.checks:
            check_whole("checks", number, 0)
        if not self.checks:
            raise ValueError("checks must name at least one number, such as 0")
        check_file("json", self.json)
        check_folder("failures", self.failures)
        for name, asked in (("checks", any(self.checks)), ("failures", self.failures is not None)):
            if asked and self.agent is None:
                raise ValueError(f"{name} concerns an agent, and none is given")


@dataclass(frozen=True, kw_only=True)
class PlayConfig(AgentConfig):
    """Record a video of an agent's movements.

    Example: viapoint play runs/first --video movements.mp4 --scenes hard
    """

    video: Path = Path("movements.mp4")
    """MP4 file to write."""
    scenes: str = "test"
    """Scene set: validation, test, hard, uniform, or a scene file."""
    n_scenes: int = 8
    """Number of scenes, evenly spread over the set."""
    checks: int = 0
    """Number of proposals that the agent checks with exact geometry; 0 for none."""

    least: ClassVar = {"n_scenes": 1, "checks": 0}

    def _check(self) -> None:
        super()._check()
        if self.agent is None:
            raise ValueError("name an agent: run folder, model folder or id")
        check_file("video", self.video, ".mp4")


@dataclass(frozen=True, kw_only=True)
class LiveConfig(AgentConfig):
    """Serve a page in the browser on which scenes are changed by hand and the agent decides anew.

    Example: viapoint live --pretrained viapoint/PandaObstacles-v0
    """

    env: Annotated[str | None, ENV] = None
    """Id of the environment; where no agent is shipped for it, the geometry search decides."""
    host: str = "127.0.0.1"
    """Address to listen on; other machines reach any but 127.0.0.1."""
    port: int = 8080
    """Port to listen on; 0 for a free one."""
    seed: int | None = None
    """Seed of the random scenes."""

    least: ClassVar = {"port": 0, "seed": 0}

    def _check(self) -> None:
        super()._check()
        if self.env is not None:
            check_env(self.env)


@dataclass(frozen=True, kw_only=True)
class BenchConfig(Config):
    """Measure throughput relative to the physics engine alone and to a plain array copy.

    Example: viapoint bench --json bench.json
    """

    env: EnvId = DEFAULT_ENV
    """Id of the environment."""
    num_envs: int = 512
    """Environments in the batch."""
    repeats: int = 9
    """Alternating measurements of each side; environments count with their mean, primitives with the fastest."""
    workers: int = 0
    """Worker processes to compare with as many threads; 0 leaves the comparison out."""
    json: Path | None = None
    """JSON file for the figures."""

    least: ClassVar = {"num_envs": 1, "repeats": 1, "workers": 0}

    def _check(self) -> None:
        check_env(self.env)
        if self.workers > self.num_envs:
            raise ValueError(
                f"workers must be at most num_envs, which is {self.num_envs}, got {self.workers}"
            )
        check_whole_movements(self.env)
        check_file("json", self.json)


@dataclass(frozen=True, kw_only=True)
class PaperConfig(Config):
    """Reproduce the claims and figures of Flash & Hogan 1985 with the model and on the simulated arm.

    Example: viapoint paper --out paper
    """

    out: Path = Path("paper")
    """Folder for the figures and the table."""
    agent: Path | None = None
    """Run folder or model folder of the agent that moves around the rows of lights; default: the shipped agent."""
    guide: Path | None = None
    """Folder for the small pictures of docs/flash-hogan.md."""

    def _check(self) -> None:
        check_folder("out", self.out)
        check_folder("guide", self.guide)


@dataclass(frozen=True, kw_only=True)
class DemoConfig(Config):
    """Train an agent, evaluate it, and write table, figures and a video to one folder.

    Example: viapoint demo --out runs/demo
    """

    out: Path = Path("runs/demo")
    """Folder for all files; existing results are kept."""
    env: EnvId = DEFAULT_ENV
    """Id of the environment."""
    seed: int = 0
    """Seed of the training."""
    n_timesteps: int | None = None
    """Decisions in total; default: a quarter of those of the preset."""
    n_scenes: int | None = None
    """Number of test scenes, evenly spread over the set; all if not given."""
    checks: int = 16
    """Number of proposals that the agent checks with exact geometry in its second row of the table."""

    least: ClassVar = {"seed": 0, "n_timesteps": 1, "n_scenes": 1, "checks": 1}

    def _check(self) -> None:
        check_env(self.env)
        check_whole_movements(self.env)
        check_has_scenes(self.env)
        check_folder("out", self.out)

    @property
    def total_timesteps(self) -> int:
        """Decisions of a new training."""
        return self.n_timesteps or TrainConfig(env=self.env).total_timesteps // 4


@dataclass(frozen=True, kw_only=True)
class DoctorConfig(Config):
    """Check what works on this machine, and print what to install where something does not.

    Example: viapoint doctor
    """

    out: Path = Path("runs")
    """Folder for runs, which is checked for write access."""
    json: bool = False
    """Print JSON instead of text."""


@dataclass(frozen=True, kw_only=True)
class ImportConfig(Config):
    """Convert an archive of Stable-Baselines3 into a model folder. Opening such an archive runs its code.

    Example: viapoint import-sb3 model.zip --env viapoint/PlanarObstacles-v0 --out models/mine --trust
    """

    file: tyro.conf.Positional[Path]
    """Archive that `model.save` of Stable-Baselines3 wrote."""
    env: Annotated[str | None, ENV] = None
    """Id of the environment that the model was trained on, with default arguments; default: the one that an archive by
    `viapoint export` names, otherwise viapoint/PlanarObstacles-v0."""
    out: Path
    """Folder for the model, which must be new."""
    algo: Algorithm | None = None
    """Algorithm; recognised from the archive if not given."""
    trust: bool = False
    """Open the archive without asking, because you trust its source."""

    def _check(self) -> None:
        if self.env is not None:
            check_env(self.env)
        check_folder("out", self.out)


@dataclass(frozen=True, kw_only=True)
class TuneConfig(Config):
    """Search for hyperparameters with Optuna. The same command continues a search; several may work on one folder.

    Example: viapoint tune benchmarks/tuning/sac_obstacles.yaml --workers 2 --out runs/tune
    """

    file: tyro.conf.Positional[Path]
    """YAML file that describes the search: environment, algorithm, budget, parameters with ranges (docs/tuning.md)."""
    out: Path | None = None
    """Folder of the search; default: runs/tune-<name of the file>."""
    trials: int | None = None
    """Number of trials in total, over all calls and processes; default: that of the file."""
    workers: int | None = None
    """Number of trainings at the same time; default: 1, or on Ray as many as fit."""
    on: str = "local"
    """Place of the trainings: local, ray, or ray://HOST:PORT."""

    least: ClassVar = {"trials": 1, "workers": 1}

    def _check(self) -> None:
        check_folder("out", self.out)

    @property
    def folder(self) -> Path:
        """Folder of the search."""
        return self.out or Path("runs") / f"tune-{self.file.stem}"


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Config):
    """Write an agent as an archive of Stable-Baselines3 with a model card, for example to share it on Hugging Face.

    Example: viapoint export viapoint/PlanarObstacles-v0 --out shared/planar-obstacles --scenes test
    """

    agent: Annotated[tyro.conf.Positional[str], AGENT]
    """Run folder, model folder, or id of an environment with a shipped agent."""
    out: Path
    """Folder for the archive and its card README.md, or a file that ends in .zip, with the card beside it."""
    scenes: tuple[str, ...] = ()
    """Scene sets in which the agent is measured for the card, such as test hard; measurements that a run folder holds
    are there already."""
    license: str | None = None
    """Licence of the model in its card, such as mit; default: mit for shipped agents, none for others."""

    def _check(self) -> None:
        check_folder("out", self.out.parent if self.out.suffix == ".zip" else self.out)


@dataclass(frozen=True, kw_only=True)
class StudyConfig(Config):
    """Run a study: trainings, evaluations, baselines and pages that a YAML file describes. A second call continues.

    Example: viapoint study benchmarks/results.yaml --workers 2
    """

    file: tyro.conf.Positional[Path]
    """YAML file that describes the study (docs/studies.md)."""
    on: str = "local"
    """Place of the jobs: local, ray, or ray://HOST:PORT."""
    workers: int | None = None
    """Number of jobs at the same time; default: 1, or on Ray as many as fit."""
    only: tuple[Literal["train", "evaluate", "baselines", "time", "page"], ...] = (
        "train", "evaluate", "baselines", "time", "page",
    )  # fmt: skip
    """Steps to run."""
    redo: tuple[str, ...] = ()
    """Patterns of rows whose measurements these steps make again, such as viaq, 'viaq/*' or 'PandaReach-v0/*'."""

    least: ClassVar = {"workers": 0}
