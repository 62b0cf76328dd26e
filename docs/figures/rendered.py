"""Rendered pictures of the documentation: `python docs/figures/rendered.py`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from hero import WOOD, drawn, pictures
from PIL import Image

from viapoint.envs import Box, Pose, inverse_kinematics, load_arm
from viapoint.envs.common.arrays import Frame
from viapoint.envs.geometry.obstacles import unpack
from viapoint.envs.renderer import SceneView
from viapoint.envs.scenes.scene import Scenes
from viapoint.training import GeometrySearch, load_agent, plan_motion
from viapoint.training.checks import SHIPPED_IDS
from viapoint.training.planning.baselines import Method, Straight, agent_method
from viapoint.training.planning.search import registered_task
from viapoint.training.rollout import SceneSimulation
from viapoint.training.scene_sets import scenes_for
from viapoint.training.video import play

ROOT = Path(__file__).parents[2]
IN_PLANE, IN_SPACE = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
STILLS = {
    "planar_reach.png": ("viapoint/PlanarReach-v0", 0, 1.0),
    "planar_obstacles.png": (IN_PLANE, 2, 1.0),
    "planar_whole_arm.png": ("viapoint/PlanarWholeArm-v0", 5, 1.0),
    "planar_target_jump.png": ("viapoint/PlanarTargetJump-v0", 0, 1.0),
    "planar_moving_obstacles.png": ("viapoint/PlanarMovingObstacles-v0", 0, 1.0),
    "panda_reach.png": ("viapoint/PandaReach-v0", 0, 0.6),
    "panda_moving_obstacles.png": ("viapoint/PandaMovingObstacles-v0", 4, 0.7),
    "panda_sensed.png": ("viapoint/PandaSensed-v0", 2, 0.6),
}
"""Tasks of the pictures of single movements, which of the scenes that show something, and the moment, as a share of the
duration: at the end, the hand of an arm in space hides the goal."""
SIZE = 480, 480
"""Width and height of them, [pixels]."""
TRIED = 100
"""Scenes among which those that are shown are chosen."""
CLEAREST = 0.012
"""Least clearance of a movement that is shown, [m]."""
GAP = 6
"""Gap between frames side by side, [pixels]."""
SHELVES, MOMENT = (39, 82), 0.6
"""Rows of the validation set that are shown in space, and the moment, as a fraction of the duration."""
CORNER: dict[str, Any] = {
    "camera": np.array([2.2, -1.5, 1.05]),
    "look_at": np.array([0.28, 0.02, 0.41]),
    "field": 24.5,
}
"""View of the scenes in space."""
UR5E = ROOT / "docs" / "ur5e.xml"
UR5E_HOME = (0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28)


class Shown(NamedTuple):
    """Scenes of a task that show what a method does."""

    method: Method
    """Shipped agent, or a search where none is shipped."""
    straight: Method
    """Method of straight movements."""
    scenes: Scenes


def shown(env_id: str, number: int) -> Shown:
    """Return scenes of the validation set in which straight movements fail, and those of the method are clear."""
    simulation = SceneSimulation(env_id, TRIED)
    task = simulation.task
    method: Method = GeometrySearch(task)
    if env_id in SHIPPED_IDS:
        checks = 0 if task.sensor else 16
        method = agent_method("agent", load_agent(env_id), checks)
    plain = Straight(simulation)
    scenes = scenes_for("validation", task).scenes.take(slice(0, TRIED))
    observation = simulation.observe(scenes)
    found = simulation.play(method, scenes, method.decide(observation, scenes))
    passes = found["is_success"] & (found["min_clearance"] > CLEAREST)
    if task.n_obstacles[1]:
        passes &= ~simulation(scenes, plain.decide(observation, scenes))["is_success"]
    simulation.close()
    rows = np.flatnonzero(passes)[:number]
    if len(rows) < number:
        raise RuntimeError(f"{len(rows)} scenes of {env_id} show something, not {number}")
    return Shown(method, plain, scenes.take(rows))


def still(path: Path, env_id: str, number: int, share: float) -> None:
    """Render one movement of a task at a share of its duration."""
    some = shown(env_id, number + 1)
    env = gym.make(env_id)
    play(env, some.scenes.take([number]), some.method.decide)
    (episodes,) = env.unwrapped.batch._episodes  # type: ignore[attr-defined]
    view = SceneView(episodes.simulator.single(), *SIZE)
    (frame,) = drawn(view, episodes, [share], SIZE)
    env.close()
    Image.fromarray(frame).save(path, optimize=True)


def side_by_side(frames: Sequence[Frame]) -> Image.Image:
    """Return frames in one row with white gaps between them."""
    gap = np.full((len(frames[0]), GAP, 3), 255, np.uint8)
    return Image.fromarray(np.concatenate([part for frame in frames for part in (gap, frame)][1:], axis=1))


def in_space(path: Path) -> None:
    """Render the Panda in some scenes, each with a plan."""
    task = registered_task(IN_SPACE)
    scenes = scenes_for("validation", task).scenes
    frames = []
    for row in SHELVES:
        obstacles = unpack(scenes.obstacles, row)
        plan = plan_motion(task.arm, scenes.start[row], scenes.goal[row], obstacles, rng=0)
        frames += pictures(plan, [WOOD] * len(obstacles), [MOMENT], (480, 400), **CORNER)
    side_by_side(frames).save(path, optimize=True)


def own_arm(path: Path) -> None:
    """Render the file of the page on arms of one's own, at two moments of a plan."""
    arm = load_arm(UR5E, home=UR5E_HOME)
    board = Box((0.25, 0.02, 0.20), position=(0.58, 0.0, 0.20))
    shelf = Box((0.20, 0.20, 0.02), position=(0.45, 0.45, 0.58))
    down = (0.0, 1.0, 0.0, 0.0)
    start = inverse_kinematics(arm, (0.45, -0.35, 0.20), down)[0]
    goal = Pose((0.45, 0.45, 0.20), down)
    plan = plan_motion(arm, start, goal, [board, shelf], margin=0.01, enough=16, rng=0)
    print(plan)
    view_of = {"camera": np.array([1.9, -1.1, 1.05]), "look_at": np.array([0.25, 0.06, 0.22]), "field": 31.0}
    frames = pictures(plan, [WOOD] * 2, (0.5, 1.0), (480, 360), **view_of)
    side_by_side(frames).save(path, optimize=True)


def main() -> None:
    """Render all pictures."""
    parser = argparse.ArgumentParser(description="Render the pictures of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder to write to")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, shown_as in STILLS.items():
        still(out / name, *shown_as)
    in_space(out / "panda_obstacles.png")
    own_arm(out / "own_arm.png")
    for path in sorted(out.iterdir()):
        print(f"{path}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
