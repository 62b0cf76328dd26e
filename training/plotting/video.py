"""Videos of several movements with captions of their outcomes."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Frame
from viapoint.envs.rendering.renderer import EpisodeRenderer
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.config.checks import check_file
from viapoint.training.io.files import MARK
from viapoint.training.planning.motion_plan import MotionPlan, executed
from viapoint.training.rollouts.rollout import Decide

CAPTION = 48  # Height of the caption below the picture, [pixels]
BLOCK = 16  # Encoders need sides that are multiples of this, [pixels]
SPEED = 0.5  # Speed of videos relative to real time
PLAN_SIZE, PLAN_FPS = (640, 480), 50
"""Size of the pictures of a plan, [pixels], and pictures per second of its movement."""
PAUSE = 0.8  # Time for which each result stays, [s]


def record_video(
    path: str | Path, env: gym.Env[Any, Any], scenes: Scenes, decide: Decide, *, name: str = "agent"
) -> int:
    """Record one episode in each scene as an MP4, and return the number of frames.

    Args:
        path: MP4 file; its folder must exist.
        env: Environment made with `render_mode="rgb_array_list"`.
        scenes: Scenes with as many rows for obstacles as the environment has.
        decide: Function from observation and scene, of one row each, to actions, shape (1, m).
        name: Name of the method, for the caption.

    Raises:
        ValueError: The path has another suffix or is a file of something else, the environment has another render
            mode, or there is no scene.
        GLUnavailableError: There is no OpenGL library.
    """
    path = Path(path).expanduser()
    check_file("path", path, ".mp4")
    if env.render_mode != "rgb_array_list":
        raise ValueError(f"env must be made with render_mode='rgb_array_list', got {env.render_mode!r}")
    if not len(scenes.start):
        raise ValueError("scenes must hold at least one scene")
    fps = float(env.metadata["render_fps"])
    part = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.part.mp4")
    try:
        count = _write_mp4(part, _scenes(env, scenes, decide, name, fps), fps * SPEED)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return count


def record_plan(path: str | Path, plan: MotionPlan) -> int:
    """Record the execution of a plan as an MP4, and return the number of frames.

    Args:
        path: MP4 file; its folder must exist.
        plan: Plan.

    Raises:
        ValueError: The path has another suffix or is a file of something else.
        GLUnavailableError: There is no OpenGL library.
    """
    path = Path(path).expanduser()
    check_file("path", path, ".mp4")
    outcome, episodes = executed([plan])
    info = {name: value[0] for name, value in outcome._asdict().items()}
    film = EpisodeRenderer(episodes, 0, "rgb_array_list", *PLAN_SIZE, PLAN_FPS)
    left = f"{plan.source}   {plan.duration:.2f} s   planned in {plan.milliseconds:.0f} ms"
    hold = round(PAUSE * SPEED * PLAN_FPS)
    try:
        frames = _with_captions(iter(film.render()), left, *describe_outcome(info), hold=hold)
        return _write_mp4(path, frames, PLAN_FPS * SPEED)
    finally:
        film.close()


def _scenes(env: gym.Env[Any, Any], scenes: Scenes, decide: Decide, name: str, fps: float) -> Iterator[Frame]:
    """Yield the frames of a movement in each scene and of a pause after it."""
    number = len(scenes.start)
    for i in range(number):
        info = play(env, scenes.take([i]), decide)
        left = f"{name}   {i + 1}/{number}   {info['duration']:.2f} s"
        frames: Any = env.unwrapped.render()
        yield from _with_captions(
            iter(frames), left, *describe_outcome(info), hold=round(PAUSE * SPEED * fps)
        )


def _write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> int:
    """Encode frames of equal size, with even numbers of pixels, as an MP4 file (H.264), and return their number."""
    count, writer = 0, None
    try:
        for frame in frames:
            if writer is None:
                height, width = frame.shape[:2]
                writer = imageio_ffmpeg.write_frames(
                    str(path), (width, height), fps=fps, codec="libx264", quality=None, bitrate=None,
                    output_params=["-crf", "20", "-movflags", "+faststart", "-metadata", f"comment={MARK.decode()}"],
                    macro_block_size=1, ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(frame))
            count += 1
    finally:
        if writer is not None:
            writer.close()
    return count


def describe_outcome(info: dict[str, Any]) -> tuple[str, Colour]:
    """Return the outcome of a movement in a few words, and their colour."""
    if info["is_success"]:
        return f"success   clearance {1e3 * info['min_clearance']:.0f} mm", PALETTE.goal
    if not info["reachable"]:
        return "out of reach", PALETTE.contact
    if info["collision"]:
        return f"collision at {info['first_contact_time']:.2f} s", PALETTE.contact
    return f"missed by {1e3 * info['goal_error']:.0f} mm", PALETTE.contact


def play(env: gym.Env[Any, Any], scene: Scenes, decide: Decide) -> dict[str, Any]:
    """Simulate an episode of an environment in one scene, and return the info of its last decision."""
    batch: Any = env.unwrapped.batch  # type: ignore[attr-defined]
    observation = batch.begin(scene)
    while True:
        decision = batch.execute_actions(decide(observation, scene))
        observation = decision.observation
        if decision.terminated[0] or decision.truncated[0]:
            return {name: value[0] for name, value in decision.info.items()}


def _with_captions(
    frames: Iterator[Frame], left: str, right: str, colour: Colour, *, hold: int
) -> Iterator[Frame]:
    """Yield frames with a caption, which shows the result after the movement, and hold the last one."""
    before = after = frame = None
    for frame in frames:
        before = _caption(frame.shape[1], left, "", colour) if before is None else before
        yield _stacked(frame, before)
    if frame is not None:
        after = _caption(frame.shape[1], left, right, colour)
        for _ in range(max(hold, 1)):
            yield _stacked(frame, after)


def _caption(width: int, left: str, right: str, colour: Colour) -> Frame:
    """Return the caption of a picture, shape (CAPTION, width, 3)."""
    image = Image.new("RGB", (width, CAPTION), "white")
    pen = ImageDraw.Draw(image)
    size = max(10, min(16, width // 30))
    plain = ImageFont.truetype(findfont("DejaVu Sans"), size)
    bold = ImageFont.truetype(findfont("DejaVu Sans:bold"), size)
    pen.text((14, CAPTION // 2), left, font=plain, fill=_bytes(PALETTE.executed), anchor="lm")
    pen.text((width - 14, CAPTION // 2), right, font=bold, fill=_bytes(colour), anchor="rm")
    return np.asarray(image)


def _stacked(frame: Frame, caption: Frame) -> Frame:
    """Stack a picture on its caption, cut to the sizes that encoders accept."""
    whole = np.concatenate((frame, caption))
    height, width = (side - side % BLOCK if side >= BLOCK else side for side in whole.shape[:2])
    return whole[whole.shape[0] - height :, :width]


def _bytes(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in colour)
    return red, green, blue
