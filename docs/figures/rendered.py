"""Rendered pictures and animations of the documentation: `python docs/figures/rendered.py`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from dataflow import draw_flow
from PIL import Image

from viapoint.envs import load_arm
from viapoint.envs.common.types import Float, Frame
from viapoint.envs.scenes.scene import Scenes
from viapoint.training import GeometrySearch, load_agent
from viapoint.training.planning.baselines import agent_method
from viapoint.training.scene_sets.scene_set import load

ROOT = Path(__file__).parents[2]
SEEDS = {"PlanarReach": 4, "PlanarObstacles": 15, "PlanarWholeArm": 1}
"""Seeds of scenes that are typical of a task."""
FILES = {
    "PlanarReach": "planar_reach.png",
    "PlanarObstacles": "planar_obstacles.png",
    "PlanarWholeArm": "planar_whole_arm.png",
}
IN_PLANE, IN_SPACE = "viapoint/PlanarObstacles-v0", "viapoint/PandaObstacles-v0"
PASSAGES = {IN_PLANE: (29, 4, 10, 37), IN_SPACE: (122, 39, 110)}
"""Scenes of `test` in which the shipped agents are shown; in space a gap in a wall, a bin, and a cupboard."""
REPLANNING = {"viapoint/PlanarMovingObstacles-v0": (2, 45), "viapoint/PlanarTargetJump-v0": (3,)}
"""Scenes of `validation` in which the shipped agents with replanning are shown."""
MOMENTS = (0.3, 0.45, 0.6, 1.0)
"""Moments of a movement that are shown, as fractions of its duration."""
ATTEMPTS = 400
"""Number of random movements that are tried in a scene."""
SCENES = 10
"""Number of scenes that are tried."""
SAFE = 0.012
"""Least clearance of a movement that is shown, [m]."""
SPEED = 0.5
"""Speed of the animations relative to real time."""
GAP = 6
"""Gap between frames side by side, [pixels]."""
PAUSE = 700
"""Pause after each movement of an animation, [ms]."""


class Solved(NamedTuple):
    """Scene with a successful action."""

    scene: Scenes
    """Scene of one row."""
    action: Float
    """Shape (m,)."""


def solve(env: gym.Env[Any, Any], seed: int) -> Solved:
    """Return the smoothest successful movement among random ones, in the scene of a seed.

    Where none succeeds, the scenes of the next seeds are tried.

    Raises:
        RuntimeError: No movement succeeds in any of the scenes.
    """
    task: Any = env.unwrapped.task  # type: ignore[attr-defined]
    for scene_seed in range(seed, seed + SCENES):
        scene = task.sampler()([np.random.default_rng(scene_seed)])
        generator = np.random.default_rng(seed)
        best, least = None, np.inf
        for _ in range(ATTEMPTS):
            action = generator.uniform(-1.0, 1.0, task.action.size).astype(np.float32)
            env.reset(options=scene.as_options())
            info = env.step(action)[-1]
            good = info["is_success"] and info["min_clearance"] > SAFE
            if good and info["jerk_ratio"] < least:
                best, least = action, info["jerk_ratio"]
        if best is not None:
            return Solved(scene, np.asarray(best))
    raise RuntimeError(
        f"none of {ATTEMPTS} random movements succeeds in the scenes of seeds {seed} and after"
    )


def perform(env: gym.Env[Any, Any], solved: Solved) -> Any:
    """Execute a movement and return what the environment renders."""
    env.reset(options=solved.scene.as_options())
    env.step(solved.action)
    return env.render()


def picture(task: str, path: Path) -> None:
    """Render one movement of a task."""
    env = gym.make(f"viapoint.envs:viapoint/{task}-v0", render_mode="rgb_array")
    frame = perform(env, solve(env, SEEDS[task]))
    env.close()
    Image.fromarray(frame).save(path, optimize=True)


def animation(path: Path, *, size: int = 400) -> None:
    """Save the shipped agent's movements in the plane as an endless animation."""
    env = gym.make(IN_PLANE, render_mode="rgb_array_list", width=size, height=size)
    films = [passage(env, IN_PLANE, row) for row in PASSAGES[IN_PLANE]]
    env.close()
    _animate(path, films, env.metadata["render_fps"])


def replanning(path: Path, *, size: int = 320) -> None:
    """Save the episodes of the shipped agents with replanning as an endless animation."""
    films = []
    for env_id, rows in REPLANNING.items():
        agent, scenes = load_agent(env_id), load("validation", env_id).scenes
        decide = agent_method("agent", agent, 0).decide
        env: Any = gym.make(env_id, render_mode="rgb_array_list", width=size, height=size)
        for row in rows:
            scene, over = scenes.take([row]), False
            observation, _ = env.reset(options=scene.as_options())
            while not over:
                action = decide({name: part[None] for name, part in observation.items()}, scene)[0]
                observation, _, over, _, _ = env.step(action.astype(np.float32))
            films.append(list(env.render()))
        env.close()
    _animate(path, films, env.metadata["render_fps"])


def _animate(path: Path, films: list[list[Frame]], fps: float) -> None:
    """Save sequences of frames as one endless animation."""
    images = [Image.fromarray(frame) for frames in films for frame in frames]
    each = round(1000.0 / (fps * SPEED))
    durations = [time for frames in films for time in (*[each] * (len(frames) - 1), PAUSE)]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=durations, loop=0, quality=80, method=4
    )


def passage(env: gym.Env[Any, Any], env_id: str, row: int, *, straight: bool = False) -> list[Frame]:
    """Return the frames of the shipped agent's movement in a test scene, or of the straight one until its contact.

    Raises:
        RuntimeError: The agent's movement fails, or the straight one succeeds.
    """
    scene, agent = load("test", env_id).scenes.take([row]), load_agent(env_id)
    return film(env, scene.as_options(), None if straight else agent_method("agent", agent, 16))


def film(env: gym.Env[Any, Any], scene: dict[str, Any], method: Any) -> list[Frame]:
    """Return the frames of a method's movement in a scene, or without a method of the straight one until its contact.

    Raises:
        RuntimeError: The method's movement fails, or the straight one succeeds.
    """
    observation, _ = env.reset(options=scene)
    task: Any = env.unwrapped.task  # type: ignore[attr-defined]
    batch = {name: part[None] for name, part in observation.items()}
    action = np.zeros(task.action.size) if method is None else method.decide(batch, None)[0]
    info = env.step(action.astype(np.float32))[-1]
    if info["is_success"] is (method is None):
        raise RuntimeError(f"the scene shows nothing: is_success is {info['is_success']}")
    frames: list[Frame] = env.render()  # type: ignore[assignment]
    if method is None:
        frames = frames[: 1 + round(info["first_contact_time"] / info["duration"] * (len(frames) - 1))]
    return frames


def side_by_side(frames: Sequence[Frame]) -> Frame:
    """Return frames in one row with white gaps between them."""
    gap = np.full((len(frames[0]), GAP, 3), 255, np.uint8)
    return np.concatenate([part for frame in frames for part in (gap, frame)][1:], axis=1)


def passages(strip: Path, pair: Path, film: Path) -> None:
    """Render the shipped agent in space: moments of a movement beside the straight one, and an animation."""
    sides = {strip: 300, pair: 480, film: 300}
    for path, side in sides.items():
        env = gym.make(IN_SPACE, render_mode="rgb_array_list", width=side, height=side)
        if path == film:
            _animate(
                path, [passage(env, IN_SPACE, row) for row in PASSAGES[IN_SPACE]], env.metadata["render_fps"]
            )
        else:
            row = PASSAGES[IN_SPACE][0]
            frames, hit = passage(env, IN_SPACE, row), passage(env, IN_SPACE, row, straight=True)[-1]
            moments = MOMENTS if path == strip else MOMENTS[1:2]
            shown = [frames[round(moment * (len(frames) - 1))] for moment in moments]
            Image.fromarray(side_by_side((*shown, hit))).save(path, optimize=True)
        env.close()


def own_arm(path: Path, seed: int = 7, side: int = 480) -> None:
    """Render the arm of the page on arms of one's own: the plan of a search beside the straight movement."""
    ur5e = load_arm(
        ROOT / "docs" / "ur5e.xml",
        hand_site="hand",
        joints=("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"),
        home=(0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28),
        velocity_limit=np.pi,
    )
    env = gym.make("viapoint/Obstacles-v0", arm=ur5e, render_mode="rgb_array_list", width=side, height=side)
    env.reset(seed=seed)
    scene = env.unwrapped.batch.scenes.as_options()  # type: ignore[attr-defined]
    frames = film(env, scene, GeometrySearch(env.unwrapped.task))  # type: ignore[attr-defined]
    moment = frames[round(MOMENTS[1] * (len(frames) - 1))]
    Image.fromarray(side_by_side((moment, film(env, scene, None)[-1]))).save(path, optimize=True)
    env.close()


def flow(path: Path) -> None:
    """Draw the flow from action to observation with the data of one movement."""
    env = gym.make("viapoint.envs:viapoint/PlanarObstacles-v0", render_mode="rgb_array")
    solved = solve(env, SEEDS["PlanarObstacles"])
    observation, _ = env.reset(options=solved.scene.as_options())
    info = env.step(solved.action)[-1]
    draw_flow(path, env, solved.scene, solved.action, observation, info)
    env.close()


def main() -> None:
    """Render all pictures."""
    parser = argparse.ArgumentParser(description="Render the pictures of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="folder to write to")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for task, name in FILES.items():
        picture(task, out / name)
    animation(out / "reaching.webp")
    replanning(out / "revising.webp")
    passages(out / "panda_agent.png", out / "panda_obstacles.png", out / "panda.webp")
    own_arm(out / "own_arm.png")
    flow(out / "flow.png")
    for path in sorted(out.iterdir()):
        print(f"{path}  {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
