"""Rendered pictures and animations of the documentation: `python docs/figures/rendered.py`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from PIL import Image

from viapoint.envs import load_arm
from viapoint.envs.common.types import Frame
from viapoint.envs.scenes.scene import Scenes
from viapoint.training import GeometrySearch, load_agent
from viapoint.training.config.checks import SHIPPED_IDS
from viapoint.training.planning.baselines import Method, Straight, agent_method
from viapoint.training.plotting.video import play
from viapoint.training.rollouts.rollout import SceneSimulation
from viapoint.training.scene_sets.scene_set import scenes_for

ROOT = Path(__file__).parents[2]
IN_PLANE, IN_SPACE = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
STILLS = {
    "planar_reach.png": "viapoint/PlanarReach-v0",
    "planar_obstacles.png": IN_PLANE,
    "planar_whole_arm.png": "viapoint/PlanarWholeArm-v0",
}
"""Tasks of the pictures of single movements."""
FILMED = 4
"""Number of scenes of the animation."""
TRIED = 100
"""Scenes among which those that are shown are chosen."""
CLEAREST = 0.012
"""Least clearance of a movement that is shown, [m]."""
MOMENT = 0.45
"""Moment of a movement that is shown, as a fraction of its duration."""
SPEED = 0.5
"""Speed of the animation relative to real time."""
GAP = 6
"""Gap between frames side by side, [pixels]."""
PAUSE = 700
"""Pause after each movement of the animation, [ms]."""


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
    shipped = env_id in SHIPPED_IDS
    method: Method = agent_method("agent", load_agent(env_id), 16) if shipped else GeometrySearch(task)
    plain = Straight(simulation)
    scenes = scenes_for("validation", task).scenes.take(slice(0, TRIED))
    observation = simulation.observe(scenes)
    found = simulation.play(method, scenes, method.decide(observation, scenes))
    passes = found.success & (found.info["min_clearance"] > CLEAREST)
    if task.n_obstacles[1]:
        passes &= ~simulation(scenes, plain.decide(observation, scenes)).success
    simulation.close()
    rows = np.flatnonzero(passes)[:number]
    if len(rows) < number:
        raise RuntimeError(f"{len(rows)} scenes of {env_id} show something, not {number}")
    return Shown(method, plain, scenes.take(rows))


def film(env: gym.Env[Any, Any], scene: Scenes, method: Method) -> list[Frame]:
    """Return the frames of an episode, which ends with the first contact."""
    play(env, scene, method.decide)
    frames: Any = env.unwrapped.render()
    return list(frames)


def still(path: Path, env_id: str) -> None:
    """Render one movement of a task."""
    some = shown(env_id, 1)
    env = gym.make(env_id, render_mode="rgb_array")
    play(env, some.scenes, some.method.decide)
    frame: Any = env.unwrapped.render()
    env.close()
    Image.fromarray(frame).save(path, optimize=True)


def animation(path: Path, env_id: str, size: int = 320) -> None:
    """Save episodes of a task as an endless animation."""
    env = gym.make(env_id, render_mode="rgb_array_list", width=size, height=size)
    some = shown(env_id, FILMED)
    films = [film(env, some.scenes.take([row]), some.method) for row in range(FILMED)]
    env.close()
    each = round(1000.0 / (env.metadata["render_fps"] * SPEED))
    images = [Image.fromarray(frame) for frames in films for frame in frames]
    durations = [time for frames in films for time in (*[each] * (len(frames) - 1), PAUSE)]
    options: Any = {"duration": durations, "loop": 0, "quality": 80, "method": 4}
    images[0].save(path, save_all=True, append_images=images[1:], **options)


def side_by_side(frames: Sequence[Frame]) -> Image.Image:
    """Return frames in one row with white gaps between them."""
    gap = np.full((len(frames[0]), GAP, 3), 255, np.uint8)
    return Image.fromarray(np.concatenate([part for frame in frames for part in (gap, frame)][1:], axis=1))


def beside_straight(path: Path, env: gym.Env[Any, Any], some: Shown) -> None:
    """Render a moment of a movement beside the contact of the straight one."""
    frames, hit = (film(env, some.scenes, method) for method in (some.method, some.straight))
    side_by_side((frames[round(MOMENT * (len(frames) - 1))], hit[-1])).save(path, optimize=True)
    env.close()


def in_space(path: Path, side: int = 480) -> None:
    """Render the Panda among furniture."""
    env = gym.make(IN_SPACE, render_mode="rgb_array_list", width=side, height=side)
    beside_straight(path, env, shown(IN_SPACE, 1))


def own_arm(path: Path, seed: int = 7, side: int = 480) -> None:
    """Render the arm of the page on arms of one's own: the plan of a search beside the straight movement."""
    ur5e = load_arm(
        ROOT / "docs" / "ur5e.xml",
        tool="hand",
        joints=("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
        home=(0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28),
        velocity_limit=np.pi,
    )
    simulation = SceneSimulation("viapoint/Obstacles-v0", arm=ur5e)
    some = Shown(GeometrySearch(simulation.task), Straight(simulation), simulation.draw(1, seed))
    env = gym.make("viapoint/Obstacles-v0", arm=ur5e, render_mode="rgb_array_list", width=side, height=side)
    beside_straight(path, env, some)


def main() -> None:
    """Render all pictures."""
    parser = argparse.ArgumentParser(description="Render the pictures of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder to write to")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, env_id in STILLS.items():
        still(out / name, env_id)
    animation(out / "reaching.webp", IN_PLANE)
    in_space(out / "panda_obstacles.png")
    own_arm(out / "own_arm.png")
    for path in sorted(out.iterdir()):
        print(f"{path}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
