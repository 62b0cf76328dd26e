"""Videos and galleries of several movements with captions of their outcomes."""

from __future__ import annotations

import itertools
import os
import textwrap
import uuid
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio_ffmpeg
import numpy as np
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.lines import Line2D
from PIL import Image, ImageDraw, ImageFont

from viapoint.envs.common.arrays import Frame
from viapoint.envs.common.palette import PALETTE, Colour
from viapoint.envs.renderer import EpisodeRenderer
from viapoint.envs.scenes.scene import Scenes
from viapoint.training.files import MARK, write_figure
from viapoint.training.planning.motion_plan import MotionPlan, execute_plans
from viapoint.training.report import progress_bar
from viapoint.training.rollout import Decide, play_episodes

CAPTION = 48  # Height of the caption below the picture, [pixels]
BLOCK = 16  # Encoders need sides that are multiples of this, [pixels]
SPEED = 0.5  # Speed of videos relative to real time
PLAN_SIZE, PLAN_FPS = (640, 480), 50  # Pictures of a plan, [pixels], [1/s]
PAUSE = 0.8  # Time for which each result stays, [s]
TILE = 2.6  # Width of one picture, [inch]
RESOLUTION = 110  # Resolution, [dots per inch]
COLUMNS = 4  # Number of pictures in a row
# Colours of the palette by their names in the legend
MARKS = {"planned": "plan", "executed": "executed", "via-point": "via", "goal": "goal", "contact": "contact"}
LINE = 28  # Greatest number of characters of the heading above one picture


def record_video(
    path: Path, env: gym.Env[Any, Any], scenes: Scenes, decide: Decide, *, name: str = "agent"
) -> int:
    """Record one episode in each scene as an MP4, and return the number of frames.

    The environment is made with `render_mode="rgb_array_list"`, and has as many rows for obstacles as the scenes.
    `decide` takes observation and scene, of one row each, and returns actions, shape (1, m). `name` is for the caption.
    Without an OpenGL library, GLUnavailableError is raised.
    """
    fps = float(env.metadata["render_fps"])
    number = len(scenes.start)
    told = "only the hand must clear" if env.get_wrapper_attr("task").hand_alone else ""

    def frames() -> Iterator[Frame]:
        for i in progress_bar(iterable=range(number), desc=name, unit=" scenes"):
            info = play(env, scenes.take([i]), decide)
            left = f"{name}   {i + 1}/{number}   {info['duration']:.2f} s"
            yield from _with_captions(env.unwrapped.render(), left, info, fps, told)

    return _write_mp4(path, frames(), fps)


def record_plan(path: Path, plan: MotionPlan) -> int:
    """Record the execution of a plan as an MP4, and return the number of frames; see :func:`record_video`."""
    outcome, episodes = execute_plans([plan])
    info = {name: value[0] for name, value in outcome._asdict().items()}
    film = EpisodeRenderer(episodes, 0, "rgb_array_list", *PLAN_SIZE, PLAN_FPS)
    left = f"{plan.source}   {plan.duration:.2f} s   planned in {plan.milliseconds:.0f} ms"
    try:
        return _write_mp4(path, _with_captions(film.render(), left, info, PLAN_FPS), PLAN_FPS)
    finally:
        film.close()


def _write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> int:
    """Encode frames of equal size, at least one, as a slow MP4 file (H.264), and return their number."""
    path = Path(os.path.realpath(path))  # a link to a file stays a link
    path.parent.mkdir(parents=True, exist_ok=True)
    full = OSError(f"the encoder could not write {path}: is there room on the disk?")
    part = path.with_name(f".{path.stem}.{uuid.uuid4().hex}.part.mp4")
    frames = iter(frames)
    first = next(frames)
    height, width = first.shape[:2]
    writer = imageio_ffmpeg.write_frames(
        str(part), (width, height), fps=SPEED * fps, codec="libx264", quality=None, bitrate=None,
        output_params=["-crf", "20", "-movflags", "+faststart", "-metadata", f"comment={MARK.decode()}"],
        macro_block_size=1, ffmpeg_log_level="error",
    )  # fmt: skip
    count = 0
    try:
        writer.send(None)  # the generator opens the file
        for frame in itertools.chain([first], frames):
            try:
                writer.send(np.ascontiguousarray(frame))
            except OSError:
                raise full from None
            count += 1
        writer.close()  # the file is complete now, if the encoder has not failed, which it does not tell
        if MARK not in part.read_bytes():
            raise full
        os.replace(part, path)
    finally:
        writer.close()
        part.unlink(missing_ok=True)  # what is left of a film that failed
    return count


def describe_outcome(info: dict[str, Any]) -> tuple[str, Colour]:
    """Return the outcome of a movement in a few words, and their colour."""
    if info["is_success"]:
        return f"success   clearance {1e3 * info['min_clearance']:.0f} mm", PALETTE.goal
    if not info["reachable"]:
        return "out of reach", PALETTE.contact
    if info["collision"]:
        return f"collision at {info['first_contact_time']:.2f} s", PALETTE.contact
    return "missed the goal", PALETTE.contact  # the error is in m or in rad


def play(env: gym.Env[Any, Any], scene: Scenes, decide: Decide) -> dict[str, Any]:
    """Simulate an episode of an environment in one scene, and return the info of its last decision."""
    batch: Any = env.unwrapped.batch  # type: ignore[attr-defined]
    observation = batch.begin(scene)
    outcomes = play_episodes(batch, scene, decide(observation, scene), decide)
    return {name: value[0] for name, value in outcomes.items()}


def _with_captions(given: Any, left: str, info: Any, fps: float, told: str = "") -> Iterator[Frame]:
    """Yield frames with a caption that tells something, and the last one for a pause with the outcome in its place."""
    outcome, colour = describe_outcome(info)
    frames = list(given)
    plain = _caption(frames[0].shape[1], left, told, PALETTE.start)
    final = _caption(frames[0].shape[1], left, outcome, colour)
    for frame in frames:
        yield _stacked(frame, plain)
    for _ in range(round(PAUSE * SPEED * fps)):
        yield _stacked(frames[-1], final)


def _caption(width: int, left: str, right: str, colour: Colour) -> Frame:
    """Return the caption of a picture, shape (CAPTION, width, 3)."""
    image = Image.new("RGB", (width, CAPTION), "white")
    pen = ImageDraw.Draw(image)
    size = max(10, min(16, width // 30))
    plain = ImageFont.truetype(findfont("DejaVu Sans"), size)
    bold = ImageFont.truetype(findfont("DejaVu Sans:bold"), size)
    pen.text((14, CAPTION // 2), left, font=plain, fill=to_hex(PALETTE.executed), anchor="lm")
    pen.text((width - 14, CAPTION // 2), right, font=bold, fill=to_hex(colour), anchor="rm")
    return np.asarray(image)


def _stacked(frame: Frame, caption: Frame) -> Frame:
    """Stack a picture on its caption, cut to the sizes that encoders accept."""
    whole = np.concatenate((frame, caption))
    height, width = (side - side % BLOCK if side >= BLOCK else side for side in whole.shape[:2])
    return whole[whole.shape[0] - height :, :width]


def gallery(
    path: Path, env: gym.Env[Any, Any], scenes: Scenes, decide: Decide, titles: Sequence[str], heading: str
) -> None:
    """Play an episode in each scene, and save a page of their last pictures as a PNG file.

    `titles` are the texts below the pictures. The environment is made with `render_mode="rgb_array"`; the rest is as
    for :func:`record_video`.
    """
    rows = -(-len(titles) // COLUMNS)
    lines = textwrap.wrap(heading, LINE * COLUMNS)
    height = (TILE + 0.5) * rows + 0.55 + 0.2 * len(lines)
    figure = Figure(figsize=(TILE * COLUMNS, height), dpi=RESOLUTION)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    grid = figure.subplots(rows, COLUMNS, squeeze=False)
    for axes in grid.flat:
        axes.set(xticks=[], yticks=[], frame_on=False)
    for row, (axes, title) in enumerate(zip(grid.flat, titles, strict=False)):
        outcome, colour = describe_outcome(play(env, scenes.take([row]), decide))
        axes.imshow(env.unwrapped.render())
        axes.set_title(outcome, fontsize=8.5, color=colour, fontweight="bold", pad=3)
        axes.set_xlabel(title, fontsize=8, color=PALETTE.joint)
    handles = [Line2D([], [], color=getattr(PALETTE, name), linewidth=4) for name in MARKS.values()]
    figure.legend(handles, list(MARKS), loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    figure.suptitle("\n".join(lines), fontsize=11, color=PALETTE.executed)
    write_figure(path, figure)
