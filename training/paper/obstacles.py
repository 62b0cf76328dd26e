"""Row 12 (Fig. 8): comparison of a method that avoids the paper's rows of lights with the paper's subjects."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from viapoint.envs import Plan, Scenes
from viapoint.envs.geometry.obstacles import pack
from viapoint.envs.scenes.scene import resting
from viapoint.primitives import speed_valleys
from viapoint.training import GeometrySearch, load_agent
from viapoint.training.checks import DEFAULT_ENV
from viapoint.training.paper import movements
from viapoint.training.paper.claim import Claim, Range, at_least, at_most, near
from viapoint.training.paper.movements import PLANE, TARGETS, Profile, SimulatedMovements, simulate
from viapoint.training.paper.one_via import slow_and_fast
from viapoint.training.planning.baselines import Method, agent_method
from viapoint.training.rollout import SceneSimulation

LENGTHS = (0.15, 0.2, 0.25)  # Lengths of the rows of lights, [m]; the paper's were up to 25 cm
RADII = (0.008, 0.02)  # Half widths of the rows of lights, [m]
SHIFTS = ((0.0, 0.0), (-0.05, 0.02), (0.05, -0.02))  # Shifts along and across the line, [m]


class ObstacleMovements(NamedTuple):
    """Successful movements of a method around rows of lights."""

    name: str
    scenes: Scenes  # Scenes of the successful movements
    plan: Plan
    motion: SimulatedMovements
    n_scenes: int  # Number of all scenes
    profiles: list[Profile]  # Profiles on the simulated arm


def light_scenes(n_rows: int) -> Scenes:
    """Return 252 scenes with rows of lights of several lengths, widths and places, and room for obstacles."""
    ends, lights = [], []
    for length, radius, shift in itertools.product(LENGTHS, RADII, SHIFTS):
        for first, last, row in movements.rows_of_lights(length, radius, shift):
            ends.append((TARGETS[first], TARGETS[last]))
            lights.append([row])
    joints = PLANE.joints(np.array(ends))
    return resting(joints[:, 0].copy(), joints[:, 1].copy(), pack(lights, n_rows))


def light_movements(agent: Path | None) -> ObstacleMovements:
    """Simulate the movements of an agent, or without one of a search, around the rows of lights.

    An agent of another task, or one that gets around no row, raises ValueError.
    """
    if agent is None:
        simulation = SceneSimulation(DEFAULT_ENV, 256)
        method: Method = GeometrySearch(simulation.task)
    else:
        found = load_agent(agent)
        simulation = SceneSimulation(found.env_id, 256, **found.env_kwargs)
        method = agent_method("agent", found, 0)
    task = simulation.task
    fits = task.whole_movement and task.space_name == "hand" and task.arm.name == "planar"
    if not fits or not task.n_obstacles[1] or "box" not in task.shapes:
        needed = f"a task of the plane with boxes and whole movements, such as {DEFAULT_ENV}"
        raise ValueError(f"agent must be of {needed}; that of {agent} is of {simulation.env_id}")
    scenes = light_scenes(task.observation.n_rows)
    action = method.decide(simulation.observe(scenes), scenes)
    success = simulation(scenes, action)["is_success"]
    simulation.close()
    if not success.any():
        raise ValueError(f"{method.name} gets around none of {len(scenes.start)} rows of lights")
    kept = scenes.take(success)
    plan = task.action.decode(action[success], PLANE.coordinates(kept.start), PLANE.coordinates(kept.goal))
    motion = simulate(plan.trajectory())
    profiles = movements.arm_profiles(motion)
    return ObstacleMovements(method.name, kept, plan, motion, len(scenes.start), profiles)


def features(profiles: list[Profile], plan: Plan) -> pd.DataFrame:
    """Compute the features of the paper's analysis, with the point of greatest curvature as via-point.

    A line for each movement, with NaN where it lacks a feature, holds the times of speed valley and curvature peak (as
    fractions of the duration), d1 / (d1 + d2) of that point, the residual of t1 / (t1 + t2) from the model through it
    (Fig. 10B), whether both have a valley or neither, and the distance from the model / that of the targets (Fig. 8).
    """
    lines = []
    for profile, (start, *_, goal) in zip(profiles, plan.waypoints, strict=True):
        line: dict[str, Any] = {"valley": profile.valley[0], "bend": profile.bend[0], "agrees": False}
        lines.append(line)
        if np.isfinite(line["bend"]):
            points = np.stack((start, profile.place(line["bend"]), goal))
            model = movements.minimum_jerk_through(points)
            distance = np.linalg.norm(np.asarray(model(profile.time)) - profile.position, axis=-1)
            line["along"], _ = movements.construction(points)
            line["residual"] = line["bend"] - movements.passage_share(model)
            line["agrees"] = bool(speed_valleys(model).time.size) == bool(np.isfinite(line["valley"]))
            line["apart"] = distance.max() / np.linalg.norm(goal - start)
    columns = ["valley", "bend", "along", "residual", "agrees", "apart"]
    return pd.DataFrame(lines, columns=columns).astype(float)


def obstacle_claims(avoidance: ObstacleMovements) -> list[Claim]:
    """Return the claims of row 12, the numbers of Fig. 8."""
    arm = features(avoidance.profiles, avoidance.plan)
    model = features(movements.model_profiles(avoidance.plan.trajectory()), avoidance.plan)
    worst, number = avoidance.motion.worst, len(arm)
    apart, arm_apart, scaled = slow_and_fast(avoidance.plan.trajectory(), 101)
    who = f"{avoidance.name}, {number} movements"

    def claim(text: str, paper: str, value: Callable[..., float], expected: Range, unit: str = "") -> Claim:
        numbers = (value(model), expected), (value(arm), expected)
        return Claim(12, f"{text} ({who})", "8", paper, *numbers, worst, unit)

    return [
        Claim(12, f"Around rows of lights without contact, of {avoidance.n_scenes} scenes ({avoidance.name})", "8",
              arm=(100.0 * number / avoidance.n_scenes, at_least(90.0)), deviation=worst, unit="%"),
        claim("Movements with a curvature peak inside", "all", lambda f: 100 * f.bend.notna().mean(),
              at_least(50.0), "%"),
        claim("Movements with a speed valley: not all", "all", lambda f: 100 * f.valley.notna().mean(),
              at_least(10.0), "%"),
        claim("A valley exactly where the model through the point of greatest curvature has one", "-",
              lambda f: 100 * f.agrees.mean(), at_least(90.0), "%"),
        claim("Valley and curvature peak: median distance in time / t_f, where there are both", "at the same time",
              lambda f: (f.valley - f.bend).abs().median(), at_most(0.05)),
        claim("Isochrony: median of |t1/(t1+t2) - .5| at the curvature peak", "roughly .5",
              lambda f: (f.bend - 0.5).abs().median(), at_most(0.1)),
        claim("t1/(t1+t2) minus the model's through the point of greatest curvature: mean", "-.004",
              lambda f: f.residual.mean(), near(0.0, 0.02)),
        claim("The same: standard deviation", ".02", lambda f: f.residual.std(ddof=0), at_most(0.04)),
        claim("The same: slope over d1/(d1+d2); it has a trend, in the model as on the arm", "no trend",
              lambda f: f.along.cov(f.residual) / f.along.var(), at_least(0.005)),
        claim("Distance from the model through the point of greatest curvature / distance of the targets: median",
              "close match", lambda f: 100 * f.apart.median(), at_most(5.0), "%"),
        Claim(12, f"Time scaling: every movement again in 1.1 s and .85 s: greatest distance of the paths ({who})",
              "8, 11", "the same path", (apart, at_most(1e-9)), (arm_apart, at_most(1.0)),
              max(each.worst for each in scaled), "mm"),
    ]  # fmt: skip
