"""Description of a study: environments, agents, grids of their settings, baselines and pages, read from YAML.

Everything is checked when the file is read: unknown fields, ids, algorithms and baselines are errors that name what is
allowed. docs/studies.md explains the fields.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Self, get_args

from viapoint.envs.registration import ENV_IDS, REPLANNING_TASKS, STEP_TASKS
from viapoint.training.algorithms.model_io import ALGORITHMS, argument_names
from viapoint.training.config.checks import check_env_kwargs, check_whole
from viapoint.training.config.configs import TrainConfig
from viapoint.training.config.presets import Algorithm, preset_of
from viapoint.training.io.files import read_yaml
from viapoint.training.planners.baselines import METHODS, REPLANNING_METHODS
from viapoint.training.scene_sets.scene_set import SETS, shipped_path
from viapoint.training.study.fields import (
    Values,
    check_fields,
    check_number,
    expanded,
    listed,
    mapping,
    named,
    seeds_of,
    unknown,
)

TWINS = {whole: step for step, whole in STEP_TASKS.items()}
"""Environments in which an action lasts one control step, by the ids of those of whole movements."""
MEASURED = tuple(name for name in SETS if name != "validation")
"""Sets that are measured by default; models are selected on `validation`."""
COUNTED = ("search", "sobol", "random_order")
"""Baselines that check `checks` plans: the search with refinement, the points of a Sobol sequence, random plans."""
OWN_METHODS = ("stored", *COUNTED)
"""Baselines that only a study has; `stored` are the planner's solutions in the files of scenes."""
UNTIMED = ("stored", "straight", "constant", "random", "unrevised")
"""Baselines whose decisions are not timed by default, as they compute nothing."""
FIXED = ("env", "seed", "out", "resume", "progress")
"""Fields of a training that the study sets."""
TRAINING_FIELDS = tuple(each.name for each in dataclasses.fields(TrainConfig) if each.name not in FIXED)
"""Fields of a training that an agent may set."""


@dataclass(frozen=True, kw_only=True)
class Environment:
    """Environment of a study."""

    name: str
    """Name in folders and tables."""
    id: str
    """Id of the registered environment."""
    env_kwargs: Values = field(default_factory=dict)
    """Arguments of the environment, for agents and baselines."""
    scenes: tuple[str, ...]
    """Names of the measured sets, or files of scenes."""
    n_scenes: int | None = None
    """Number of scenes of each set, from the first on; all if not given."""

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return self.name.rpartition("/")[2]


@dataclass(frozen=True, kw_only=True)
class Entry:
    """Agent or baseline of a study."""

    name: str
    """Name of its folder, and of its row."""
    label: str
    """Name in tables."""
    environments: tuple[str, ...]
    """Names of its environments."""
    timed: bool = True
    """True to measure the time of single decisions."""


class Mode(NamedTuple):
    """Decision mode of an agent."""

    checks: int = 0
    """Number of proposals that are checked with computed geometry."""
    untrained: bool = False
    """True for the network before training."""
    unrevised: bool = False
    """True for the first plan alone."""

    @property
    def _parts(self) -> list[str]:
        parts = {"untrained": self.untrained, "unrevised": self.unrevised, f"{self.checks}": self.checks}
        return [part for part, there in parts.items() if there]

    @property
    def name(self) -> str:
        """Name in files."""
        return "-".join(self._parts) or "alone"

    def row(self, agent: str) -> str:
        """Return the id of an agent's row, such as `viaq`, `viaq/16`, `viaq/untrained/16` and `viaq/unrevised`."""
        return "/".join([agent, *self._parts])


@dataclass(frozen=True, kw_only=True)
class Agent(Entry):
    """Learning algorithm with its settings."""

    training: Values
    """Fields of :class:`TrainConfig`, without those that the study sets."""
    seeds: tuple[int, ...]
    """Seeds of its trainings."""
    checks: tuple[int, ...] = (0,)
    """Numbers of proposals that it checks with exact geometry, a row each; 0 for none."""
    untrained: bool = False
    """True for rows of its network before training, with each number of checks."""
    unrevised: bool = False
    """True for a row of its first plan alone, where plans are revised."""
    step_wise: bool = False
    """True for training on the twin of the environment in which an action lasts one control step."""
    cpus: int = 1
    """Cores of each training."""
    resources: Values = field(default_factory=dict)
    """Resources of each training that a node of the cluster must have, such as {GPU: 1}."""

    def modes(self, env_id: str | None = None) -> list[Mode]:
        """Return all decision modes, or those in an environment, the network alone first if it is asked for."""
        revised = env_id is None or env_id in REPLANNING_TASKS
        found = [Mode(checks) for checks in self.checks]
        found += [Mode(unrevised=True)] if self.unrevised and revised else []
        return found + [Mode(checks, untrained=True) for checks in self.checks if self.untrained]

    def config(self, env: Environment, seed: int, out: Path) -> TrainConfig:
        """Return the configuration of a training; `policy_kwargs` are merged with those of the preset."""
        env_id = TWINS[env.id] if self.step_wise else env.id
        given = dict(self.training)
        hyperparameters = dict(given.pop("hyperparameters", {}))
        if "policy_kwargs" in hyperparameters:
            usual = preset_of(env_id, given.get("algo", "viaq")).arguments().get("policy_kwargs", {})
            hyperparameters["policy_kwargs"] = {**usual, **hyperparameters["policy_kwargs"]}
        given["env_kwargs"] = {**env.env_kwargs, **given.get("env_kwargs", {})}
        return TrainConfig(
            env=env_id, seed=seed, out=out, progress=False, hyperparameters=hyperparameters, **given
        )


@dataclass(frozen=True, kw_only=True)
class Baseline(Entry):
    """Method without training."""

    method: str
    """Name of the method."""
    checks: int | None = None
    """Number of plans that a search checks."""
    time_of: str | None = None
    """Row of an agent, in whose time of a decision a search checks as many plans as it can."""
    env_kwargs: Values = field(default_factory=dict)
    """Arguments of the environment besides its own, such as the number of via-points."""
    scenes: tuple[str, ...] | None = None
    """Sets that are measured; those of the environment if not given."""
    n_scenes: int | None = None
    """Number of scenes of each set; that of the environment if not given."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """Files that are made of the measurements; templates are Jinja2 and may be beside the study."""

    file: Path
    """Page in Markdown."""
    record: Path
    """JSON file with every number."""
    figures: Path
    """Folder of the figures."""
    template: Path | None = None
    """Template of the page; that of the package if not given."""
    tables: Path | None = None
    """Template with a macro for each table of `into`."""
    into: tuple[Path, ...] = ()
    """Pages with tables between `<!-- table:NAME -->` and `<!-- end -->`, which the macro NAME writes."""
    shown: tuple[str, ...] = ()
    """Rows in figures; those of all agents if not given."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """Environments, agents and baselines, as a YAML file describes them.

    Example:
        >>> from viapoint.training import Study
        >>> study = Study.from_dict(
        ...     {
        ...         "seeds": [0, 1],
        ...         "environments": ["viapoint/PlanarReach-v0"],
        ...         "agents": {
        ...             "viaq": {"checks": [0, 16]},
        ...             "sac-{batch_size}": {
        ...                 "algo": "sac",
        ...                 "grid": {"hyperparameters.batch_size": [128, 256]},
        ...             },
        ...         },
        ...         "baselines": ["straight", "search64"],
        ...     },
        ...     name="small",
        ... )
        >>> [agent.name for agent in study.agents], [baseline.name for baseline in study.baselines]
        (['viaq', 'sac-128', 'sac-256'], ['straight', 'search64'])
        >>> study.out.as_posix()
        'runs/small'
    """

    name: str
    """Name of the study."""
    out: Path
    """Folder of all runs and measurements."""
    seeds: tuple[int, ...]
    """Seeds of the trainings of agents that name none."""
    environments: tuple[Environment, ...]
    agents: tuple[Agent, ...]
    baselines: tuple[Baseline, ...]
    compare: tuple[tuple[str, str], ...]
    """Pairs of rows that are compared scene by scene, or run by run."""
    page: Page

    @classmethod
    def from_yaml(cls, path: str | Path) -> Self:
        """Read a study from a YAML file.

        Raises:
            ValueError: The file cannot be read, or something in it is not allowed; the message lists what is.
        """
        path = Path(path)
        try:
            return cls.from_dict(read_yaml(path), name=path.stem, folder=path.parent)
        except ValueError as error:
            raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from error

    @classmethod
    def from_dict(cls, given: Values, *, name: str = "study", folder: str | Path = ".") -> Self:
        """Return a study from plain values.

        Args:
            given: Values by the names of the YAML file's fields.
            name: Name of the study, if `given` has none.
            folder: Folder of templates and files of scenes.

        Raises:
            ValueError: Something is not allowed; the message lists what is.
        """
        folder = Path(folder)
        check_fields("the study", given, _TOP)
        name = str(given.get("name", name))
        out = Path(given.get("out", Path("runs") / name))
        seeds = seeds_of("seeds", given.get("seeds", [0]))
        environments = tuple(_environments(given.get("environments"), given.get("scenes"), folder))
        known = {each.name: each for each in environments}
        agents = tuple(
            _agent(*each, known, seeds) for each in expanded("agents", given.get("agents", {}), AGENT_FIELDS)
        )
        baselines = tuple(
            _baseline(*each, known, agents)
            for each in expanded("baselines", given.get("baselines", {}), BASELINE_FIELDS)
        )
        names = [each.name for each in (*agents, *baselines)]
        for each in names:
            if names.count(each) > 1:
                raise ValueError(f"agents and baselines must have different names, {each} is there twice")
        rows = [row for agent in agents for row in rows_of(agent)] + [each.name for each in baselines]
        compare = tuple(_compared(pair, rows) for pair in listed("compare", given.get("compare", [])))
        page = _page(given.get("page", {}), out, folder, rows)
        return cls(
            name=name,
            out=out,
            seeds=seeds,
            environments=environments,
            agents=agents,
            baselines=baselines,
            compare=compare,
            page=page,
        )

    def environment(self, name: str) -> Environment:
        """Return the environment of a name."""
        return next(each for each in self.environments if each.name == name)


_TOP = ("name", "out", "seeds", "scenes", "environments", "agents", "baselines", "compare", "page")
_ENVIRONMENT_FIELDS = ("id", "env_kwargs", "scenes", "n_scenes")
_ENTRY_FIELDS = ("label", "environments", "timed", "grid")
_AGENT_OWN = ("seeds", "checks", "untrained", "unrevised", "step_wise", "cpus", "resources")
_BASELINE_OWN = ("method", "checks", "time_of", "env_kwargs", "scenes", "n_scenes")
AGENT_FIELDS = (*_ENTRY_FIELDS, *_AGENT_OWN, *TRAINING_FIELDS)
"""Fields of an agent."""
BASELINE_FIELDS = (*_ENTRY_FIELDS, *_BASELINE_OWN)
"""Fields of a baseline."""


def rows_of(agent: Agent) -> list[str]:
    """Return the ids of an agent's rows."""
    return [mode.row(agent.name) for mode in agent.modes()]


def _environments(given: Any, scenes: Any, folder: Path) -> Iterator[Environment]:
    """Yield environments from a list of ids, or from values by name."""
    for name, fields in named("environments", given):
        where = f"environments.{name}"
        check_fields(where, fields, _ENVIRONMENT_FIELDS)
        env_id = fields.get("id", name)
        if env_id not in ENV_IDS or env_id in STEP_TASKS:
            raise ValueError(
                unknown(f"{where}: id", env_id, [each for each in ENV_IDS if each not in STEP_TASKS])
            )
        kwargs = mapping(f"{where}.env_kwargs", fields.get("env_kwargs", {}))
        check_env_kwargs(kwargs)
        sets = _sets(f"{where}.scenes", fields.get("scenes", scenes), env_id, folder)
        n_scenes = fields.get("n_scenes")
        check_number(f"{where}.n_scenes", n_scenes)
        yield Environment(name=name, id=env_id, env_kwargs=kwargs, scenes=sets, n_scenes=n_scenes)


def _sets(where: str, given: Any, env_id: str, folder: Path) -> tuple[str, ...]:
    """Return the measured sets of an environment: by default those that are shipped for it."""
    shipped = [name for name in SETS if shipped_path(name, env_id).is_file()] or list(SETS[:2])
    if given is None:
        return tuple(name for name in shipped if name in MEASURED)
    found = []
    for name in listed(where, given):
        if name in SETS:
            found += [name] if name in shipped else []
        elif (folder / str(name)).is_file():
            found.append(str(folder / str(name)))
        else:
            raise ValueError(unknown(where, name, SETS) + " (or the path of a file of scenes)")
    return tuple(found)


def _agent(
    where: str, name: str, label: str, fields: Values, known: Mapping[str, Environment], seeds: Sequence[int]
) -> Agent:
    """Return an agent whose configuration is allowed in each of its environments."""
    algo = fields.get("algo", "viaq")
    if algo not in get_args(Algorithm):
        raise ValueError(unknown(f"{where}: algo", algo, get_args(Algorithm)))
    step_wise = bool(fields.get("step_wise", False))
    possible = [each for each, env in known.items() if not step_wise or env.id in TWINS]
    checks = tuple(listed(f"{where}.checks", fields.get("checks", [0])))
    for number in checks:
        check_whole(f"{where}.checks", number, 0)
    if any(checks) and algo != "viaq":
        raise ValueError(f"{where}: checks are those of viaq; {algo} has no proposals to check")
    check_whole(f"{where}.cpus", fields.get("cpus", 1), 1)
    agent = Agent(
        name=name,
        label=label,
        environments=_chosen(f"{where}.environments", fields.get("environments"), possible, known),
        timed=bool(fields.get("timed", True)),
        training={each: fields[each] for each in TRAINING_FIELDS if each in fields},
        seeds=seeds_of(f"{where}.seeds", fields["seeds"]) if "seeds" in fields else tuple(seeds),
        checks=checks,
        untrained=bool(fields.get("untrained", False)),
        unrevised=bool(fields.get("unrevised", False)),
        step_wise=step_wise,
        cpus=fields.get("cpus", 1),
        resources=mapping(f"{where}.resources", fields.get("resources", {})),
    )
    given = mapping(f"{where}.hyperparameters", fields.get("hyperparameters", {}))
    check_fields(f"{where}.hyperparameters", given, sorted(argument_names(ALGORITHMS[algo])))
    for env in agent.environments:
        try:
            agent.config(known[env], 0, Path("runs"))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where} in {env}: {error}") from error
    return agent


def _baseline(
    where: str,
    name: str,
    label: str,
    fields: Values,
    known: Mapping[str, Environment],
    agents: Sequence[Agent],
) -> Baseline:
    """Return a baseline that exists in each of its environments."""
    method = fields.get("method", name)
    allowed = tuple(dict.fromkeys([*OWN_METHODS, *METHODS, *REPLANNING_METHODS]))
    if method not in allowed:
        raise ValueError(unknown(f"{where}: method", method, allowed))
    checks, time_of = fields.get("checks"), fields.get("time_of")
    if method in COUNTED and (checks is None) is (time_of is None or method != "search"):
        raise ValueError(f"{where}: {method} needs checks, a number, or search time_of, the row of an agent")
    if method not in COUNTED and (checks is not None or time_of is not None):
        raise ValueError(f"{where}: checks and time_of are for {', '.join(COUNTED)}")
    for each, number in (("checks", checks), ("n_scenes", fields.get("n_scenes"))):
        check_number(f"{where}.{each}", number, 2 if method == "search" and each == "checks" else 1)
    rows = [row for agent in agents for row in rows_of(agent)]
    if time_of is not None and time_of not in rows:
        raise ValueError(unknown(f"{where}: time_of", time_of, rows))
    possible = [each for each, env in known.items() if _exists(method, env)]
    scenes = fields.get("scenes")
    return Baseline(
        name=name,
        label=label,
        environments=_chosen(f"{where}.environments", fields.get("environments"), possible, known),
        timed=bool(fields.get("timed", method not in UNTIMED)),
        method=method,
        checks=checks,
        time_of=time_of,
        env_kwargs=mapping(f"{where}.env_kwargs", fields.get("env_kwargs", {})),
        scenes=None if scenes is None else tuple(listed(f"{where}.scenes", scenes)),
        n_scenes=fields.get("n_scenes"),
    )


def _exists(method: str, env: Environment) -> bool:
    """Return whether a baseline exists in an environment."""
    if method in ("stored", "random_order"):
        shipped = all(shipped_path(each, env.id).is_file() for each in env.scenes if each in SETS)
        return env.id not in REPLANNING_TASKS and (method == "random_order" or shipped)
    return method in OWN_METHODS or method in (REPLANNING_METHODS if env.id in REPLANNING_TASKS else METHODS)


def _chosen(
    where: str, given: Any, possible: Sequence[str], known: Mapping[str, Environment]
) -> tuple[str, ...]:
    """Return the environments of an entry: by default all in which it exists."""
    if given is None:
        return tuple(possible)
    for name in listed(where, given):
        if name not in known:
            raise ValueError(unknown(where, name, list(known)))
        if name not in possible:
            raise ValueError(f"{where}: it does not exist in {name}, only in {', '.join(possible) or 'none'}")
    return tuple(given)


def _page(given: Any, out: Path, folder: Path, rows: Sequence[str]) -> Page:
    """Return the files of the page, by default in the folder of the study's runs."""
    names = [each.name for each in dataclasses.fields(Page)]
    fields = mapping("page", given)
    check_fields("page", fields, names)
    found: dict[str, Any] = {
        "file": Path(fields.get("file", out / "results.md")),
        "record": Path(fields.get("record", out / "results.json")),
        "figures": Path(fields.get("figures", out / "figures")),
    }
    for name in ("template", "tables"):
        if name in fields:
            found[name] = folder / fields[name]
            if not found[name].is_file():
                raise ValueError(f"page.{name}: {found[name]} is missing")
    found["into"] = tuple(Path(each) for each in listed("page.into", fields.get("into", [])))
    found["shown"] = tuple(listed("page.shown", fields.get("shown", [])))
    for row in found["shown"]:
        if row not in rows:
            raise ValueError(unknown("page.shown", row, rows))
    return Page(**found)


def _compared(pair: Any, rows: Sequence[str]) -> tuple[str, str]:
    if not isinstance(pair, list) or len(pair) != 2:
        raise ValueError(f"compare must hold pairs of rows, such as [viaq, sac], got {pair!r}")
    for row in pair:
        if row not in rows:
            raise ValueError(unknown("compare", row, rows))
    return pair[0], pair[1]
