"""Films of several movements, each with a line that says what came of it."""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.common.types import Frame, Observation
from viapoint.envs.rendering.renderer import GLUnavailableError, frame_steps
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.plotting.top_view import draw_movement

Decide = Callable[[Observation, Scenes], Any]

CAPTION = 48
"""Height of the line below the picture, [pixels]."""
BLOCK = 16
"""Encoders want sides that are multiples of this, [pixels]."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Film:
    """What was filmed."""

    path: Path
    frames: int
    """How many there are."""
    rendered: bool
    """Whether by OpenGL; if not, it is drawn."""

    def __str__(self) -> str:
        """Where it is, and what it lacks."""
        return f"{self.path}" if self.rendered else f"{self.path} (drawn from above, for want of OpenGL)"


def film(
    path: str | Path,
    env: gym.Env[Any, Any],
    scenes: Scenes,
    decide: Decide,
    *,
    name: str = "agent",
    speed: float = 0.5,
    pause: float = 0.8,
) -> Film:
    """Film one movement in each scene and save it as an MP4.

    Without an OpenGL library the movements are drawn as seen from above, and one line is logged that says so
    and names the package to install.

    Args:
        path: Of the film; its folder must exist.
        env: An environment made with `render_mode="rgb_array_list"`.
        scenes: N of them, of no more obstacles than the environment has rows.
        decide: Observation and scene, of one row each, to actions, shape (1, m): a method of the table.
        name: Who decides, for the line below the picture.
        speed: Of the film relative to real time.
        pause: How long each result stays, [s].

    Raises:
        ValueError: The path is of another kind, the environment renders otherwise, or there is nothing to film.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"path must end in .mp4, got {path}")
    if env.render_mode != "rgb_array_list":
        raise ValueError(f"env must be made with render_mode='rgb_array_list', got {env.render_mode!r}")
    if not len(scenes.start):
        raise ValueError("scenes must hold at least one scene")
    camera = Camera(env)
    part = path.with_name(f".{path.stem}.part.mp4")
    try:
        count = _write(part, _scenes(camera, scenes, decide, name, pause * speed), camera.fps * speed)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
    return Film(path=path, frames=count, rendered=camera.rendered)


def _scenes(camera: Camera, scenes: Scenes, decide: Decide, name: str, pause: float) -> Iterator[Frame]:
    """The frames of a movement in each scene, and at its end of a pause [s of the movement's time]."""
    number = len(scenes.start)
    for i in range(number):
        scene = scenes.take([i])
        observation, _ = camera.env.reset(options=scene.as_options())
        over = False
        while not over:
            action = np.asarray(decide({k: v[None] for k, v in observation.items()}, scene))[0]
            observation, _, terminated, truncated, info = camera.env.step(action.astype(np.float32))
            over = terminated or truncated
        left = f"{name}   {i + 1}/{number}   {info['duration']:.2f} s"
        yield from _with_captions(camera.frames(scene), left, *verdict(info), hold=round(pause * camera.fps))


def _write(path: Path, frames: Iterator[Frame], fps: float) -> int:
    """Encode frames of equal size; how many there were."""
    first = next(frames)
    height, width = first.shape[:2]
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=fps, codec="libx264", quality=None, bitrate=None,
        output_params=["-crf", "20", "-movflags", "+faststart"], macro_block_size=1, ffmpeg_log_level="error",
    )  # fmt: skip
    count = 0
    try:
        writer.send(None)
        for frame in itertools.chain([first], frames):
            writer.send(np.ascontiguousarray(frame))
            count += 1
    finally:
        writer.close()
    return count


def verdict(info: dict[str, Any]) -> tuple[str, Colour]:
    """What came of a movement in a few words, and their colour."""
    if info["is_success"]:
        return f"success   clearance {1e3 * info['min_clearance']:.0f} mm", PALETTE.goal
    if not info["reachable"]:
        return "out of reach", PALETTE.contact
    if info["collision"]:
        return f"collision at {info['first_contact_time']:.2f} s", PALETTE.contact
    return f"missed by {1e3 * info['goal_error']:.0f} mm", PALETTE.contact


class Camera:
    """Takes the frames of an environment's last movement, by OpenGL where there is one."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env
        self.fps = float(env.metadata["render_fps"])
        self.rendered = True
        """Whether OpenGL has worked so far."""

    def frames(self, scene: Scenes) -> Iterator[Frame]:
        """The frames of the last movement, which took place in `scene`, each of shape (height, width, 3)."""
        if self.rendered:
            try:
                yield from self.env.render()  # type: ignore[misc]
                return
            except GLUnavailableError as error:
                self.rendered = False
                log.warning("the film shows a drawn view from above: %s", error)
        yield from self._drawn(scene)

    def _drawn(self, scene: Scenes) -> Iterator[Frame]:
        inner: Any = self.env.unwrapped
        figure = Figure(figsize=(4.8, 4.8), dpi=100)
        canvas: Any = FigureCanvasAgg(figure)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        for step in frame_steps(inner.last_rollout.time, round(self.fps)):
            axes.clear()
            draw_movement(
                axes, inner.task.arm, scene, inner.last_plan, inner.last_rollout,
                whole_arm=inner.task.whole_arm, step=int(step),
            )  # fmt: skip
            canvas.draw()
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _with_captions(
    frames: Iterator[Frame], left: str, right: str, colour: Colour, *, hold: int
) -> Iterator[Frame]:
    """Frames with a line below, which says the result once the movement is over, and the last one held."""
    before = after = frame = None
    for frame in frames:
        before = _caption(frame.shape[1], left, "", colour) if before is None else before
        yield _stacked(frame, before)
    if frame is not None:
        after = _caption(frame.shape[1], left, right, colour)
        for _ in range(max(hold, 1)):
            yield _stacked(frame, after)


def _caption(width: int, left: str, right: str, colour: Colour) -> Frame:
    """The line below a picture, shape (CAPTION, width, 3)."""
    image = Image.new("RGB", (width, CAPTION), "white")
    pen = ImageDraw.Draw(image)
    size = max(10, min(16, width // 30))
    plain = ImageFont.truetype(findfont("DejaVu Sans"), size)
    bold = ImageFont.truetype(findfont("DejaVu Sans:bold"), size)
    pen.text((14, CAPTION // 2), left, font=plain, fill=_bytes(PALETTE.executed), anchor="lm")
    pen.text((width - 14, CAPTION // 2), right, font=bold, fill=_bytes(colour), anchor="rm")
    return np.asarray(image)


def _stacked(frame: Frame, caption: Frame) -> Frame:
    """Picture over caption, cut to what encoders accept."""
    whole = np.concatenate((frame, caption))
    height, width = (side - side % BLOCK if side >= BLOCK else side for side in whole.shape[:2])
    return whole[whole.shape[0] - height :, :width]


def _bytes(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * c) for c in colour)
    return red, green, blue
