"""What is trained and how often: tables of variants, and the configuration of the study."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from viapoint.envs.registration import STEP_TASKS, TASKS
from viapoint.training.algorithms.policy import ViaQPolicy
from viapoint.training.algorithms.viaq import ViaQ
from viapoint.training.config.checks import DEFAULT_ENV
from viapoint.training.config.configs import TrainConfig
from viapoint.training.config.presets import PRESETS, STEP_PRESETS, Algorithm
from viapoint.training.planners.baselines import METHODS as BASELINE_METHODS
from viapoint.training.scene_sets.scene_set import SETS, shipped_path

Table = Literal["results", "ablations", "freedom"]
Step = Literal["train", "evaluate", "baselines", "time", "page"]
MEASURED = tuple(name for name in SETS if name != "validation")
"""Sets that are measured once training is over; models are chosen on `validation` alone."""
BASELINES = (
    "stored", "straight", "constant", "random", "random16", "random80", "search16", "search64", "search512",
    "search4096", "ompl",
)  # fmt: skip
"""Baselines of the results by their names; `planner` are the solutions that are stored with the scenes."""
VALIDATIONS, CHECKPOINTS = 8, 2
"""Of each training, however long it is."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to learn."""

    name: str
    """Of its folder."""
    label: str
    """In the tables."""
    algo: Algorithm = "viaq"
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the algorithm, or of ViaQ's policy, instead of the preset's."""
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    """Of the environment."""
    step_wise: bool = False
    """Whether it learns on the environment's step-wise twin, an action in every control step."""


METHODS = (
    *(Variant(name=algo, label=algo, algo=algo) for algo in get_args(Algorithm)),
    *(
        Variant(name=f"{algo}-step", label=f"{algo} in every control step", algo=algo, step_wise=True)
        for algo in get_args(Algorithm)
        if algo in STEP_PRESETS
    ),
)
"""Each algorithm as its preset says."""
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
    Variant(
        name="viaq-action-heads",
        label="the same with 8 heads",
        settings={"form": "action", "heads": 8},
    ),
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
"""The whole agent, and the agent without each of its parts; the column without checks is measured for all of them."""
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
"""More via-points, and their timing left to the agent."""
FREEDOM_LABELS = {each.name: each.label for each in FREEDOM} | {WHOLE.name: "K = 1, optimal timing"}


@dataclass(frozen=True, kw_only=True)
class Study:
    """Train, evaluate, and write docs/results.md with its figures; a second call goes on where the first stopped.

    Example: python benchmarks/learning.py --jobs 2
    """

    out: Path = Path("runs/study")
    """Folder of the run folders and of everything measured."""
    docs: Path = Path("docs")
    """Folder for results.md, results.json and images/results_*.png."""
    envs: tuple[str, ...] = ()
    """Environments of the results; all that have frozen test scenes if not given."""
    methods: tuple[str, ...] = DEFAULT_METHODS
    """Of the results: learning algorithms, and with `-step` those that act in every control step."""
    studied: tuple[str, ...] = (DEFAULT_ENV,)
    """Environments of ablations and freedom."""
    tables: tuple[Table, ...] = get_args(Table)
    """Which tables are worked on; the page shows whatever is there."""
    only: tuple[Step, ...] = get_args(Step)
    """Which steps are taken."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Of the trainings."""
    jobs: int = 1
    """Processes that train and measure at once, each on its share of the cores; 0 works in this process."""
    baselines: tuple[str, ...] = BASELINES
    """Of the results; `stored` is the planner's solutions from the files of scenes, `planner` searches anew."""
    checks: int = 64
    """How many of an agent's proposals are checked by exact geometry in its second row."""
    alone: bool = False
    """Leave out what the page holds and these files do not, such as what was measured on another machine."""
    n_timesteps: int | None = None
    """Decisions of each training; as the preset says if not given. For trials."""
    n_scenes: int | None = None
    """Scenes of each set, at most. For trials."""

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
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
        """Of the results."""
        return self.envs or tuple(env for env in TASKS if sets_of(env))

    def variants(self, table: Table, env: str) -> tuple[Variant, ...]:
        """The rows of a table of an environment."""
        if table == "results":
            asked = (each for each in METHODS if each.name in self.methods)
            return tuple(each for each in asked if env in TWINS or not each.step_wise)
        return ABLATIONS if table == "ablations" else FREEDOM

    def cells(self) -> list[Cell]:
        """All trainings, seed after seed, so that every table has its first seed early."""
        found: dict[Cell, None] = {}
        for seed in self.seeds:
            for table in self.tables:
                for env in self.environments if table == "results" else self.studied:
                    for variant in self.variants(table, env):
                        found[Cell(env=env, variant=variant, seed=seed)] = None
        return list(found)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One training of the study."""

    env: str
    variant: Variant
    seed: int

    def __hash__(self) -> int:
        """Variants are known by their names."""
        return hash((self.env, self.variant.name, self.seed))

    def __str__(self) -> str:
        """In a line."""
        return f"{short(self.env)} {self.variant.name} seed {self.seed}"

    def folder(self, study: Study) -> Path:
        """Of the run."""
        return study.out / short(self.env) / self.variant.name / f"seed-{self.seed}"

    def training(self, study: Study) -> TrainConfig:
        """The configuration of the run."""
        config = TrainConfig(
            env=TWINS[self.env] if self.variant.step_wise else self.env,
            algo=self.variant.algo,
            seed=self.seed,
            n_timesteps=study.n_timesteps,
            out=self.folder(study),
            eval_scenes=min(study.n_scenes or 500, 500),
            env_kwargs=dict(self.variant.env_kwargs),
            hyperparameters=placed(self.variant.settings)
            if self.variant.algo == "viaq"
            else dict(self.variant.settings),
            progress=False,
        )
        total = config.total_timesteps
        return dataclasses.replace(
            config,
            eval_every=max(total // VALIDATIONS, 1),
            checkpoint_every=max(total // CHECKPOINTS, 1),
        )


def placed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as hyperparameters: ViaQ's own ones, and those of its policy in `policy_kwargs`.

    Raises:
        ValueError: Neither knows one of them.
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
    """Names of the measured sets that an environment has."""
    return [name for name in MEASURED if shipped_path(name, env).is_file()]


def short(env: str) -> str:
    """An environment's id without its namespace."""
    return env.rpartition("/")[2]
