"""Failures of an agent by kind: counts, a table and pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.scenes.scene import Scenes
from viapoint.training.evaluation.evaluator import MethodResult, evenly_spread
from viapoint.training.io.files import write_bytes, write_json
from viapoint.training.plotting.gallery import Entry, gallery, play
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets.scene_set import BANDS, FrozenScenes

MAX_GRAZE = 0.005
"""Greatest depth at which a plan grazes an obstacle, [m]."""
MAX_PICTURES = 8
"""Greatest number of pictures of each kind."""
PROPOSALS = 16
"""Number of best candidates of an agent that count as its proposals."""


class Kind(NamedTuple):
    """Kind of failure."""

    name: str
    """Name in files."""
    description: str
    """Description in tables and headings."""


KINDS = (
    Kind("out_of_reach", "the plan leaves the arm's reach or its joint limits"),
    Kind("off_goal", "nothing touched, but not at rest at the goal within the joint limits"),
    Kind("tracking", "the plan is clear, the arm that follows it touches"),
    Kind("graze", "the plan enters an obstacle by 5 mm or less"),
    Kind("wrong_way", "a clear collision the wrong way round: another of its proposals would have succeeded"),
    Kind("collision", "a clear collision, and no other proposal would have succeeded"),
)
"""Kinds in order of precedence: each failure is of the first kind that fits."""


@dataclass(frozen=True, kw_only=True)
class Failures:
    """Failures of a method among the scenes of a set."""

    method: str
    frozen: FrozenScenes
    """All scenes of the evaluation."""
    rows: NDArray[np.int64]
    """Rows of the scenes of the n failures, shape (n,)."""
    kind: NDArray[np.int64]
    """Index into KINDS, shape (n,)."""
    another: NDArray[np.bool_] | None
    """Mask of failures where another proposal succeeds, shape (n,); None for agents without proposals."""
    depth: NDArray[np.float64]
    """Depth of the plan in an obstacle, negative where it is clear, shape (n,), [m]."""
    actions: NDArray[np.float64]
    """Actions of the agent, shape (n, m)."""

    def counts(self) -> dict[str, Any]:
        """Return counts of each kind: all, by band, and those in which another proposal succeeds."""
        band = self.frozen.band[self.rows]
        return {
            each.name: {
                "count": int((self.kind == i).sum()),
                "by_band": {
                    name: int(((self.kind == i) & (band == b)).sum()) for b, name in enumerate(BANDS)
                },
                "another": None if self.another is None else int(self.another[self.kind == i].sum()),
            }
            for i, each in enumerate(KINDS)
        }


def classify(outcomes: Mapping[str, NDArray[Any]], another: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the index into KINDS of n failed movements; `another` is True where another proposal succeeds."""
    reachable, collision = (np.asarray(outcomes[name], dtype=bool) for name in ("reachable", "collision"))
    clearance = np.asarray(outcomes["planned_clearance"], dtype=np.float64)
    fits = (~reachable, ~collision, clearance > 0.0, clearance >= -MAX_GRAZE, another, np.ones_like(another))
    return np.asarray(np.argmax(np.stack(fits), axis=0))


def classify_failures(
    result: MethodResult, frozen: FrozenScenes, agent: Any, env_id: str, **env_kwargs: Any
) -> Failures:
    """Return the classified failures of an agent's evaluation.

    Args:
        result: Result of the agent.
        frozen: Scenes of the evaluation, in order.
        agent: Model; if it ranks candidates, the PROPOSALS best ones are simulated, too.
        env_id: Id of its environment.
        **env_kwargs: Arguments of its environment.
    """
    rows = np.flatnonzero(~result.success)
    outcomes = {name: np.asarray(values)[rows] for name, values in result.outcomes.items()}
    another = _another_succeeds(agent, frozen.scenes.take(rows), env_id, env_kwargs)
    return Failures(
        method=result.name,
        frozen=frozen,
        rows=rows,
        kind=classify(outcomes, np.zeros(len(rows), dtype=bool) if another is None else another),
        another=another,
        depth=-np.asarray(outcomes["planned_clearance"], dtype=np.float64),
        actions=result.actions[rows],
    )


def _another_succeeds(
    agent: Any, scenes: Scenes, env_id: str, env_kwargs: Mapping[str, Any]
) -> NDArray[np.bool_] | None:
    """Return in which of n scenes any proposal of the agent succeeds, shape (n,); None if it has no proposals."""
    number = len(scenes.start)
    if not hasattr(agent.policy, "propose"):
        return None
    if not number:
        return np.zeros(0, dtype=bool)
    simulation = SceneSimulation(env_id, **env_kwargs)
    actions = proposals(agent.policy, simulation.observe(scenes))
    every = scenes.take(np.repeat(np.arange(number), actions.shape[1]))
    success = simulation(every, actions.reshape(-1, actions.shape[-1])).success
    simulation.close()
    return np.asarray(success.reshape(number, -1).any(axis=-1))


def proposals(policy: Any, observation: Mapping[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return the candidates of greatest value in each of B scenes, shape (B, PROPOSALS, m), best first."""
    actions, values = policy.propose(observation)
    best = np.argsort(-values, axis=1, kind="stable")[:, :PROPOSALS]
    return np.take_along_axis(actions, best[..., None], axis=1).astype(np.float64)


def write_failures(failures: Failures, folder: Path, env_id: str, **env_kwargs: Any) -> list[Path]:
    """Write the table of counts as Markdown and JSON, and a page of pictures for each kind that occurs.

    The pictures of a kind range from its deepest collision to its shallowest.
    """
    table = markdown(failures.counts(), len(failures.frozen.share))
    heading = f"# Failures of {failures.method} on {env_id}, scenes {failures.frozen.name}"
    write_bytes(folder / "failures.md", f"{heading}\n\n{table}\n".encode())
    write_json(folder / "failures.json", {"method": failures.method, "kinds": failures.counts()})
    written = [folder / "failures.md", folder / "failures.json"]
    for i, kind in enumerate(KINDS):
        mine = np.flatnonzero(failures.kind == i)
        if len(mine):
            ordered = mine[np.argsort(-failures.depth[mine], kind="stable")]
            chosen = ordered[evenly_spread(len(mine), MAX_PICTURES)]
            entries = _entries(failures, chosen, env_id, env_kwargs)
            heading = f"{kind.description}: {len(mine)} of {len(failures.rows)} failures"
            written.append(gallery(folder / f"{kind.name}.png", entries, heading=heading))
    return written


def _entries(
    failures: Failures, chosen: NDArray[np.int64], env_id: str, env_kwargs: Mapping[str, Any]
) -> list[Entry]:
    """Simulate some of the failures again and return them as entries of a gallery."""
    scenes, actions = failures.frozen.scenes.take(failures.rows[chosen]), failures.actions[chosen]
    titles = [_title(failures, index) for index in chosen]
    return play(env_id, scenes, titles, lambda row, _: actions[row].astype(np.float32), **env_kwargs)


def markdown(counts: Mapping[str, Any], scenes: int) -> str:
    """Return the table of counts as Markdown."""
    lines = [
        ["kind", "failures", "of all scenes", *(f"share {band}" for band in BANDS), "another succeeds"],
        ["---", *["---:"] * (3 + len(BANDS))],
    ]
    groups = {kind.description: [counts[kind.name]] for kind in KINDS}
    for description, group in {**groups, "all": list(counts.values())}.items():
        number = sum(each["count"] for each in group)
        part = f"{100.0 * number / scenes:.1f} %" if scenes else "-"
        by_band = [str(sum(each["by_band"][band] for each in group)) for band in BANDS]
        another = [each["another"] for each in group]
        succeeds = "-" if None in another else str(sum(another))
        lines.append([description, str(number), part, *by_band, succeeds])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _title(failures: Failures, index: int) -> str:
    depth = 1e3 * failures.depth[index]
    where = f"{depth:.1f} mm deep" if depth > 0.0 else f"{-depth:.1f} mm clear"
    band = failures.frozen.band[failures.rows[index]]
    return where if band < 0 else f"{where}, share {BANDS[band]}"
