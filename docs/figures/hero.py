"""Film of the README: the Panda reaches out of a cage and under a table, and back: `python docs/figures/hero.py`."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from viapoint.envs import Box, Capsule, Cylinder, Shape, arm_of
from viapoint.envs.common.arrays import Float, Frame
from viapoint.envs.episodes import Episodes
from viapoint.envs.renderer import Canvas, SceneView, frame_steps, picture_of
from viapoint.training import MotionPlan, plan_motion
from viapoint.training.planning.motion_plan import execute_plans

SIZE = 600, 400
"""Width and height, [pixels]."""
FPS, SPEED = 20, 0.5
"""Pictures per second, and speed relative to real time."""
PAUSE = 600
"""Pause at both ends, [ms]."""
CAMERA, LOOK_AT, FIELD = np.array([2.15, -0.50, 0.78]), np.array([0.38, 0.02, 0.315]), 34.0
"""Places of the camera and of what it looks at, [m], and its field of view from top to bottom, [degree]."""
CAGE, CAGE_SIDE, CAGE_HEIGHT, GAPS = np.array([0.42, -0.40]), 0.34, 0.26, 4
"""Centre, side and height of the cage, [m], and gaps between the bars of a side."""
TABLE, TABLE_HALF, TABLE_HEIGHT = np.array([0.66, 0.30]), np.array([0.22, 0.30]), 0.44
"""Centre, half sides and height of the table, [m]."""
INSIDE = np.array([-0.78, 0.32, 0.02, -2.11, -0.01, 2.43, 0.81])
UNDER = np.array([1.14, 0.67, -0.72, -2.19, 0.19, 3.38, 1.27])
"""Joint positions with the hand in the cage, and below the table, [rad]."""
METAL, WOOD = (0.36, 0.40, 0.47, 1.0), (0.85, 0.62, 0.42, 1.0)


def cage() -> list[Shape]:
    """Return the bars of a cage that is open above."""
    half, top = CAGE_SIDE / 2.0, CAGE_HEIGHT
    corners = [np.array([x, y]) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half))]
    shapes: list[Shape] = []
    for first, second in zip(corners, corners[1:] + corners[:1], strict=True):
        rim = [(*(CAGE + corner), top) for corner in (first, second)]
        shapes.append(Capsule.between(*rim, radius=0.009))
        for share in np.arange(GAPS) / GAPS:
            place = CAGE + (1.0 - share) * first + share * second
            shapes.append(Cylinder(0.007, top / 2.0, position=(*place, top / 2.0)))
    return shapes


def table() -> list[Shape]:
    """Return a board on four legs."""
    board = Box((*TABLE_HALF, 0.012), position=(*TABLE, TABLE_HEIGHT))
    inset = TABLE_HALF - 0.03
    legs = [
        Cylinder(0.014, TABLE_HEIGHT / 2.0, position=(*(TABLE + inset * ways), TABLE_HEIGHT / 2.0))
        for ways in itertools.product((-1, 1), repeat=2)
    ]
    return [board, *legs]


def frames_of(plan: MotionPlan, colours: Sequence[Sequence[float]], step: int = 1) -> list[Frame]:
    """Return every so many of the pictures of the executed movement; obstacles have colours of their own."""
    recorded = execute_plans([plan])[1].recorded(0)
    states = frame_steps(recorded.rollout.time, round(FPS / SPEED))[::step]
    return pictures(plan, colours, states / len(recorded.rollout.time))


def pictures(
    plan: MotionPlan,
    colours: Sequence[Sequence[float]],
    shares: Iterable[float],
    size: tuple[int, int] = SIZE,
    **view_of: Any,
) -> list[Frame]:
    """Return pictures of the executed movement at shares of its duration; `view_of` are arguments of `look_from`."""
    outcome, episodes = execute_plans([plan])
    if not outcome.is_success[0]:
        raise RuntimeError("the movement touches something")
    view = SceneView(episodes.simulator.single(), *size)
    look_from(view.model, **view_of)
    for number, colour in enumerate(colours):
        view.model.geom(f"obstacle_{number}").rgba[:] = colour
    return drawn(view, episodes, shares, size)


def drawn(view: SceneView, episodes: Episodes, shares: Iterable[float], size: tuple[int, int]) -> list[Frame]:
    """Return pictures of the first of some episodes at shares of its duration."""
    recorded = episodes.recorded(0)
    canvas = Canvas(view.model, *size, supersampling=2)
    view.scene = canvas.scene
    found = []
    for share in shares:
        view.write(picture_of(episodes.task, recorded, round(share * len(recorded.rollout.time))))
        found.append(canvas.draw())
    canvas.close()
    return found


def look_from(model: Any, camera: Float = CAMERA, look_at: Float = LOOK_AT, field: float = FIELD) -> None:
    """Place the camera of a model."""
    back = (camera - look_at) / np.linalg.norm(camera - look_at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack((right, np.cross(back, right), back), axis=1)
    seen = model.camera("view")
    seen.pos[:], seen.fovy[:] = camera, field
    seen.quat[:] = Rotation.from_matrix(axes).as_quat(scalar_first=True)


def main() -> None:
    """Write the film."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/hero.webp"), help="file to write")
    parser.add_argument("--draft", type=int, default=1, help="draw every Nth picture only")
    arguments = parser.parse_args()
    bars, furniture = cage(), table()
    colours = [METAL] * len(bars) + [WOOD] * len(furniture)
    images: list[Image.Image] = []
    times: list[int] = []
    for ends in ((INSIDE, UNDER), (UNDER, INSIDE)):
        plan = plan_motion(
            arm_of("panda"), *ends, [*bars, *furniture], margin=0.015, enough=24, time_limit=20.0, rng=0
        )
        print(plan)
        frames = frames_of(plan, colours, arguments.draft)
        images += [Image.fromarray(frame) for frame in frames]
        times += [round(1000 / FPS)] * (len(frames) - 1) + [PAUSE]
    options: dict[str, Any] = {"duration": times, "loop": 0, "quality": 86, "method": 4}
    images[0].save(arguments.out, save_all=True, append_images=images[1:], **options)
    print(f"{arguments.out}  {len(images)} pictures, {arguments.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
