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
from viapoint.training.paper import Claim, claim, movements
from viapoint.training.paper.movements import PLANE, TARGETS, Profile, SimulatedMovements, simulate
from viapoint.training.paper.one_via import slow_and_fast
from viapoint.training.planning.baselines import Method, agent_method
from viapoint.training.rollout import SceneSimulation

LENGTHS = (0.15, 0.2, 0.25)  # Lengths of the rows of lights, [m]; the paper's were up to 25 cm
RADII = (0.008, 0.02)  # Half widths of the rows of lights, [m]
SHIFTS = ((0.0, 0.0), (-0.05, 0.02), (0.05, -0.02))  # Shifts along and across the line, [m]

# Numbers of the claims, from the features of the movements
NUMBERS: dict[str, Callable[[pd.DataFrame], Any]] = {
    "bends": lambda f: 100 * f.bend.notna().mean(),
    "valleys around lights": lambda f: 100 * f.valley.notna().mean(),
    "agreement": lambda f: 100 * f.agrees.mean(),
    "valley and bend": lambda f: (f.valley - f.bend).abs().median(),
    "isochrony": lambda f: (f.bend - 0.5).abs().median(),
    "mean residual": lambda f: f.residual.mean(),
    "spread of residuals": lambda f: f.residual.std(ddof=0),
    "trend of residuals": lambda f: f.along.cov(f.residual) / f.along.var(),
    "match": lambda f: 100 * f.apart.median(),
}


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
    share = 100.0 * number / avoidance.n_scenes
    claims = [claim("contacts", None, share, worst, number=avoidance.n_scenes, name=avoidance.name)]
    for key, value in NUMBERS.items():
        claims.append(claim(key, value(model), value(arm), worst, who=who))
    scaled_worst = max(each.worst for each in scaled)
    return [*claims, claim("lights scaled", apart, arm_apart, scaled_worst, who=who)]
