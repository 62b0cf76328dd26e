"""Row 12: comparison of a method that avoids the paper's rows of lights with the paper's subjects."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from viapoint.envs.common.types import Float
from viapoint.envs.geometry.obstacles import pack
from viapoint.envs.plans import Plan
from viapoint.envs.scenes.scene import Scenes, check_scenes, resting
from viapoint.envs.task import Task
from viapoint.primitives import speed_valleys
from viapoint.training.agents.agent import load_agent
from viapoint.training.config.checks import DEFAULT_ENV
from viapoint.training.paper.claim import Claim, ExpectedRange, at_least, at_most, near
from viapoint.training.paper.lights import rows_of_lights
from viapoint.training.paper.movements import (
    PLANE,
    Profile,
    SimulatedMovements,
    arm_profile,
    construction,
    minimum_jerk_through,
    model_profile,
    passage_share,
    simulate,
)
from viapoint.training.paper.rows.curved import FAST, SLOW
from viapoint.training.planning.baselines import Method, agent_method
from viapoint.training.planning.search import GeometrySearch
from viapoint.training.rollouts.rollout import SceneSimulation

LENGTHS = (0.15, 0.2, 0.25)
"""Lengths of the rows of lights, [m]; the paper's were up to 25 cm."""
RADII = (0.008, 0.02)
"""Half widths of the rows of lights, [m]."""
SHIFTS = ((0.0, 0.0), (-0.05, 0.02), (0.05, -0.02))
"""Offsets of a row's middle from the middle of the line between the targets, along and across it, [m]."""


class ObstacleMovements(NamedTuple):
    """Successful movements of a method around rows of lights."""

    name: str
    scenes: Scenes
    """Scenes of the successful movements."""
    plan: Plan
    motion: SimulatedMovements
    n_scenes: int
    """Number of all scenes."""
    planned: list[Profile]
    executed: list[Profile]


def light_scenes(n_rows: int) -> Scenes:
    """Return 252 scenes with rows of lights of several lengths, widths and places between each two targets.

    Args:
        n_rows: Rows for obstacles, of which the first is used.
    """
    ends, lights = [], []
    for length, radius, shift in itertools.product(LENGTHS, RADII, SHIFTS):
        for row in rows_of_lights(length, radius):
            along = (row.goal - row.start) / np.linalg.norm(row.goal - row.start)
            left = np.array([-along[1], along[0]])
            moved = row.lights.position + np.append(shift[0] * along + shift[1] * left, 0.0)
            lights.append([dataclasses.replace(row.lights, position=moved)])
            ends.append((row.start, row.goal))
    joints = PLANE.joints(np.array(ends))
    return resting(joints[:, 0].copy(), joints[:, 1].copy(), pack(lights, n_rows))


def light_movements(agent: Path | None) -> ObstacleMovements:
    """Simulate the movements of an agent, or without one of a search, around the rows of lights."""
    method: Method
    if agent is None:
        simulation = SceneSimulation(DEFAULT_ENV, 256)
        method = GeometrySearch(simulation.task)
    else:
        found = load_agent(agent)
        simulation = SceneSimulation(found.env_id, 256, **found.env_kwargs)
        method = agent_method("agent", found, 0)
    task = simulation.task
    scenes = light_scenes(task.observation.n_rows)
    check_scenes(scenes, task.arm)
    action = method.decide(simulation.observe(scenes), scenes)
    success = simulation(scenes, action).success
    simulation.close()
    if not success.any():
        raise ValueError(f"{method.name} gets around none of {len(scenes.start)} rows of lights")
    kept = scenes.take(success)
    plan = task.action.decode(
        action[success], task.space.coordinates(kept.start), task.space.coordinates(kept.goal)
    )
    motion = simulate(plan.trajectory())
    number = range(int(success.sum()))
    planned = [model_profile(plan.take(row).trajectory()) for row in number]
    executed = [arm_profile(motion, row) for row in number]
    return ObstacleMovements(method.name, kept, plan, motion, len(scenes.start), planned, executed)


def check_agent(agent: Path) -> None:
    """Check that the scenes of the paper are scenes of an agent's task.

    Raises:
        ValueError: The task is not of the hand in the plane, has no boxes, or needs several decisions for a movement.
    """
    found = load_agent(agent)
    task: Task = found.get_env().get_attr("task", 0)[0]  # type: ignore[union-attr]
    fits = task.whole_movement and task.space_name == "hand" and task.arm.name == "planar"
    if not fits or not task.n_obstacles[1] or "box" not in task.shapes:
        raise ValueError(
            f"agent must be of a task of the plane with boxes in which one decision is a whole movement, such as "
            f"{DEFAULT_ENV}; that of {agent} is of {found.env_id}"
        )


class Features(NamedTuple):
    """Features of the paper's analysis, one value for each movement; NaN where a movement lacks it."""

    valley: Float
    """Time of the speed valley as a fraction of the duration."""
    bend: Float
    """Time of the curvature peak."""
    via: Float
    """Position of the curvature peak, d1 / (d1 + d2) and d3 / (d1 + d2), shape (n, 2)."""
    residual: Float
    """t1 / (t1 + t2) minus the model's through the point of greatest curvature, as in Fig. 10B."""
    agrees: NDArray[np.bool_]
    """True where the movement and the model through that point both have a speed valley, or neither has."""
    apart: Float
    """Greatest distance from the model through that point / distance of the targets, as in Fig. 8."""


def features(profiles: list[Profile], plan: Plan) -> Features:
    """Compute the features of the paper's analysis, with the point of greatest curvature as via-point."""
    valley = np.array([each.valley for each in profiles])
    bend = np.array([each.bend[0] for each in profiles])
    agrees = np.zeros(len(bend), dtype=bool)
    via, (residual, apart) = np.full((len(bend), 2), np.nan), np.full((2, len(bend)), np.nan)
    for row in np.flatnonzero(np.isfinite(bend)):
        start, *_, goal = plan.waypoints[row]
        points = np.stack((start, profiles[row].place(bend[row]), goal))
        model = minimum_jerk_through(points)
        via[row] = construction(points)
        residual[row] = bend[row] - passage_share(model)
        agrees[row] = bool(speed_valleys(model).time.size) == bool(np.isfinite(valley[row]))
        distance = np.linalg.norm(np.asarray(model(profiles[row].time)) - profiles[row].position, axis=-1)
        apart[row] = distance.max() / np.linalg.norm(points[2] - points[0])
    return Features(valley, bend, via, residual, agrees, apart)


def obstacle_claims(avoidance: ObstacleMovements) -> list[Claim]:
    """Return the claims of row 12."""
    both = features(avoidance.planned, avoidance.plan), features(avoidance.executed, avoidance.plan)
    worst = avoidance.motion.worst
    who = f"{avoidance.name}, {len(avoidance.executed)} movements"

    def claim(
        text: str, paper: str, value: Callable[[Features], float], expected: ExpectedRange, unit: str = ""
    ) -> Claim:
        return Claim(
            row=12, claim=f"{text} ({who})", figure="8", paper=paper, unit=unit, model=value(both[0]),
            expected=expected, arm=value(both[1]), arm_expected=expected, deviation=worst,
        )  # fmt: skip

    return [
        Claim(
            row=12, claim=f"Around rows of lights without contact, of {avoidance.n_scenes} scenes ({avoidance.name})",
            figure="8", unit="%", model=None, arm=100.0 * len(avoidance.executed) / avoidance.n_scenes,
            arm_expected=at_least(90.0), deviation=worst,
        ),
        claim("Movements with a curvature peak inside", "all", lambda f: 100 * _share(f.bend), at_least(50.0), "%"),
        claim("Movements with a speed valley: not all", "all", lambda f: 100 * _share(f.valley), at_least(10.0), "%"),
        claim("A valley exactly where the model through the point of greatest curvature has one", "-",
              lambda f: 100 * float(f.agrees.mean()), at_least(90.0), "%"),
        claim("Valley and curvature peak: median distance in time / t_f, where there are both", "at the same time",
              lambda f: float(np.nanmedian(np.abs(f.valley - f.bend))), at_most(0.05)),
        claim("Isochrony: median of |t1/(t1+t2) - .5| at the curvature peak", "roughly .5",
              lambda f: float(np.nanmedian(np.abs(f.bend - 0.5))), at_most(0.1)),
        claim("t1/(t1+t2) minus the model's through the point of greatest curvature: mean", "-.004",
              lambda f: float(np.nanmean(f.residual)), near(0.0, 0.02)),
        claim("The same: standard deviation", ".02", lambda f: float(np.nanstd(f.residual)), at_most(0.04)),
        claim("The same: slope over d1/(d1+d2); it has a trend, in the model as on the arm", "no trend",
              lambda f: _slope(f.via[:, 0], f.residual), near(0.035, 0.015)),
        claim("Distance from the model through the point of greatest curvature / distance of the targets: median",
              "close match", lambda f: 100 * float(np.nanmedian(f.apart)), at_most(5.0), "%"),
        _scaling_claim(avoidance, who),
    ]  # fmt: skip


def _slope(place: Float, residual: Float) -> float:
    known = np.isfinite(residual)
    return float(np.polyfit(place[known], residual[known], 1)[0])


def _share(values: Float) -> float:
    return float(np.isfinite(values).mean())


def _scaling_claim(avoidance: ObstacleMovements, who: str) -> Claim:
    """Return the claim about the same decisions in the two durations of Fig. 11."""
    fractions, movement = np.linspace(0.0, 1.0, 101), avoidance.plan.trajectory()
    both = [simulate(movement.stretched(duration)) for duration in (SLOW, FAST)]
    number = len(avoidance.executed)
    paths = [np.stack([each.at(row, fractions) for row in range(number)]) for each in both]
    plans = [movement.stretched(duration).sample(101, 0)[0] for duration in (SLOW, FAST)]
    apart, model = (1e3 * float(np.linalg.norm(a - b, axis=-1).max()) for a, b in (paths, plans))
    return Claim(
        row=12, claim=f"Time scaling: every movement again in 1.1 s and .85 s: greatest distance of the paths ({who})",
        figure="8, 11", paper="the same path", unit="mm", model=model, expected=at_most(1e-9), arm=apart,
        arm_expected=at_most(1.0), deviation=max(each.worst for each in both),
    )  # fmt: skip
