"""Plan of the study: tables of variants and the configuration."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from viapoint.envs.registration import STEP_TASKS, TASKS
from viapoint.training.algorithms.viaq import ViaQ
from viapoint.training.algorithms.viaq_policy import ViaQPolicy
from viapoint.training.config.checks import DEFAULT_ENV
from viapoint.training.config.configs import TrainConfig
from viapoint.training.config.presets import PRESETS, STEP_PRESETS, Algorithm
from viapoint.training.planners.baselines import METHODS as BASELINE_METHODS
from viapoint.training.scene_sets.scene_set import SETS, shipped_path

Table = Literal["results", "ablations", "freedom"]
Step = Literal["train", "evaluate", "baselines", "time", "page"]
MEASURED = tuple(name for name in SETS if name != "validation")
"""Sets that are measured after training; models are selected on `validation` alone."""
BASELINES = (
    "stored", "straight", "constant", "random", "random16", "random80", "search16", "search64", "search512",
    "search4096", "ompl",
)  # fmt: skip
"""Baselines of the results; `stored` are the planner's solutions in the files of scenes."""
VALIDATIONS, CHECKPOINTS = 8, 2
"""Numbers of validations and of checkpoints in each training."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Variant of a learning method."""

    name: str
    """Name of its folder."""
    label: str
    """Name in tables."""
    algo: Algorithm = "viaq"
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the algorithm, or of ViaQ's policy, that replace those of the preset."""
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the environment."""
    step_wise: bool = False
    """True for training on the step-wise twin of the environment, with an action in every control step."""


METHODS = (
    *(Variant(name=algo, label=algo, algo=algo) for algo in get_args(Algorithm)),
    *(
        Variant(name=f"{algo}-step", label=f"{algo} in every control step", algo=algo, step_wise=True)
        for algo in get_args(Algorithm)
        if algo in STEP_PRESETS
    ),
)
"""Algorithms with their presets."""
WHOLE = METHODS[0]
DEFAULT_METHODS = (*get_args(Algorithm), "sac-step", "ppo-step")
TWINS = {whole: step for step, whole in STEP_TASKS.items()}
"""Step-wise twin of an environment."""
ABLATIONS = (
    WHOLE,
    Variant(
        name="viaq-action",
        label="critic of action and obstacle instead of planned poses",
        settings={"form": "action"},
    ),
    Variant(name="viaq-action-heads", label="the same with 8 heads", settings={"form": "action", "heads": 8}),
    Variant(
        name="viaq-sum",
        label="critic of action and scene: sum over obstacles (Deep Sets) instead of the minimum",
        settings={"form": "action", "pooling": "sum"},
    ),
    Variant(
        name="sac-minimum",
        label="actor of SAC instead of candidates, minimum critic of action and obstacle",
        algo="sac",
        settings={"policy_kwargs": {"critic": "minimum"}},
    ),
    Variant(
        name="td3-minimum",
        label="actor of TD3 instead of candidates, minimum critic of action and obstacle",
        algo="td3",
        settings={"policy_kwargs": {"critic": "minimum"}},
    ),
    *(each for each in METHODS if each.name in ("sac", "td3")),
    Variant(
        name="viaq-sparse",
        label="no clearance term in the reward: success and contact only",
        env_kwargs={"reward_weights": {"clearance": 0.0}},
    ),
    Variant(name="viaq-no-refinement", label="no refined candidates", settings={"refinements": 0}),
    Variant(
        name="viaq-random", label="random actions only during training", settings={"explore_uniformly": 1.0}
    ),
)
"""Whole agent, and agents without one of its parts."""
FREEDOM = tuple(
    WHOLE
    if (n_via, timing) == (1, "optimal")
    else Variant(
        name=f"viaq-k{n_via}-{timing}",
        label=f"K = {n_via}, {timing} timing",
        env_kwargs={"n_via": n_via, "timing": timing},
    )
    for n_via in (1, 2, 3)
    for timing in ("optimal", "learned")
)
"""Action spaces: one to three via-points, with optimal or learned timing."""
FREEDOM_LABELS = {each.name: each.label for each in FREEDOM} | {WHOLE.name: "K = 1, optimal timing"}


@dataclass(frozen=True, kw_only=True)
class Study:
    """Train, evaluate, and write docs/results.md with its figures; a second call continues where the first stopped.

    Example: python benchmarks/learning.py --jobs 2
    """

    out: Path = Path("runs/study")
    """Folder of run folders and evaluations."""
    docs: Path = Path("docs")
    """Folder for results.md, results.json and images/results_*.png."""
    envs: tuple[str, ...] = ()
    """Environments of the results; by default all that have frozen test scenes."""
    methods: tuple[str, ...] = DEFAULT_METHODS
    """Learning methods of the results; those with `-step` act in every control step."""
    studied: tuple[str, ...] = (DEFAULT_ENV,)
    """Environments of the tables ablations and freedom."""
    tables: tuple[Table, ...] = get_args(Table)
    """Tables to measure; the page shows all existing numbers."""
    only: tuple[Step, ...] = get_args(Step)
    """Steps to run."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the trainings."""
    jobs: int = 1
    """Number of parallel processes, each on its share of the cores; 0 for this process."""
    baselines: tuple[str, ...] = BASELINES
    """Baselines of the results; `stored` are the planner's solutions in the files of scenes, `planner` a new search."""
    checks: int = 64
    """Number of proposals that an agent checks with computed geometry in its second row."""
    alone: bool = False
    """Replace the page; by default numbers from other machines are kept."""
    n_timesteps: int | None = None
    """Decisions of each training, for trials; by default those of the preset."""
    n_scenes: int | None = None
    """Greatest number of scenes of each set, for trials."""

    def __post_init__(self) -> None:
        """Check names and ranges."""
        for name, known in (
            ("envs", [env for env in TASKS if sets_of(env)]),
            ("studied", [env for env in TASKS if sets_of(env)]),
            ("methods", [each.name for each in METHODS]),
            ("baselines", ["stored", *BASELINE_METHODS]),
        ):
            unknown = [each for each in getattr(self, name) if each not in known]
            if unknown:
                raise ValueError(f"{name} must be among {', '.join(known)}, got {unknown[0]!r}")
        for name, least in (("jobs", 0), ("checks", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be {least} or more, got {getattr(self, name)}")
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError(f"seeds must name numbers that are 0 or more, got {self.seeds}")

    @property
    def environments(self) -> tuple[str, ...]:
        """Environments of the results."""
        return self.envs or tuple(env for env in TASKS if sets_of(env))

    def variants(self, table: Table, env: str) -> tuple[Variant, ...]:
        """Return the variants of a table of an environment."""
        if table == "results":
            asked = (each for each in METHODS if each.name in self.methods)
            return tuple(each for each in asked if env in TWINS or not each.step_wise)
        return ABLATIONS if table == "ablations" else FREEDOM

    def cells(self) -> list[Cell]:
        """Return all trainings, ordered by seed, so that every table has its first seed early."""
        found: dict[Cell, None] = {}
        for seed in self.seeds:
            for table in self.tables:
                for env in self.environments if table == "results" else self.studied:
                    for variant in self.variants(table, env):
                        found[Cell(env=env, variant=variant, seed=seed)] = None
        return list(found)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Training of the study."""

    env: str
    variant: Variant
    seed: int

    def __hash__(self) -> int:
        """Return a hash; variants are identified by their names."""
        return hash((self.env, self.variant.name, self.seed))

    def __str__(self) -> str:
        """Return a label of one line."""
        return f"{short(self.env)} {self.variant.name} seed {self.seed}"

    def folder(self, study: Study) -> Path:
        """Return the folder of the run."""
        return study.out / short(self.env) / self.variant.name / f"seed-{self.seed}"

    def training(self, study: Study) -> TrainConfig:
        """Return the configuration of the run."""
        config = TrainConfig(
            env=TWINS[self.env] if self.variant.step_wise else self.env,
            algo=self.variant.algo,
            seed=self.seed,
            n_timesteps=study.n_timesteps,
            out=self.folder(study),
            eval_scenes=min(study.n_scenes or 500, 500),
            env_kwargs=dict(self.variant.env_kwargs),
            hyperparameters=split_settings(self.variant.settings)
            if self.variant.algo == "viaq"
            else dict(self.variant.settings),
            progress=False,
        )
        total = config.total_timesteps
        return dataclasses.replace(
            config, eval_every=max(total // VALIDATIONS, 1), checkpoint_every=max(total // CHECKPOINTS, 1)
        )


def split_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as hyperparameters of ViaQ, with those of its policy in `policy_kwargs`.

    Raises:
        ValueError: A setting is neither of ViaQ nor of its policy.
    """
    own, policy = (set(inspect.signature(kind.__init__).parameters) for kind in (ViaQ, ViaQPolicy))
    unknown = sorted(set(settings) - own - policy)
    if unknown:
        raise ValueError(f"cannot be trained: neither ViaQ nor its policy has a setting {unknown[0]!r}")
    result = {name: value for name, value in settings.items() if name in own}
    others = {name: value for name, value in settings.items() if name not in own}
    if others:
        result["policy_kwargs"] = {**PRESETS["viaq"].arguments().get("policy_kwargs", {}), **others}
    return result


def sets_of(env: str) -> list[str]:
    """Return the names of the measured sets of an environment."""
    return [name for name in MEASURED if shipped_path(name, env).is_file()]


def short(env: str) -> str:
    """Return the id of an environment without its namespace."""
    return env.rpartition("/")[2]
