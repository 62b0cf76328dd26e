"""Playback of executed movements on the live page, and pictures of what it shows."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from viapoint.envs.common.types import Float
from viapoint.training.live.job_thread import TICK

if TYPE_CHECKING:
    import viser

    from viapoint.training.live.movements import Segment
    from viapoint.training.live.scene_file import LiveScene
    from viapoint.training.live.scene_view import SceneView

PICTURE = 1280, 800
"""Width and height of saved pictures, [pixels]."""
RENDER_TIMEOUT = 20.0
"""Time limit of one picture from the browser, [s]."""


class Playback:
    """Playback in the view of one tab; `scene_of` returns the present scene."""

    def __init__(
        self, client: viser.ClientHandle, view: SceneView, scene_of: Callable[[], LiveScene]
    ) -> None:
        self._client, self._view, self._scene_of = client, view, scene_of
        self.done: list[Segment] = []
        """Segments of the last movement."""

    def play(self, segments: Iterator[Segment], speed: float) -> Iterator[float]:
        """Show a movement at a speed relative to real time, and yield the time until the next picture, [s].

        Each segment is computed when the one before it has been shown.
        """
        self.done = []
        began, hand = None, list[Float]()
        for segment in segments:
            if began is None:
                began = time.monotonic() - float(segment.time[0]) / speed
            if segment.restarted:
                hand = []
            if segment.path is not None:
                self._view.show_plan(segment.path, np.zeros((0, segment.hand.shape[-1])), clear=True)
            self.done.append(segment)
            shown = 0
            while shown < len(segment.time):
                elapsed = (time.monotonic() - began) * speed
                ahead = int(np.searchsorted(segment.time, elapsed))
                shown = min(max(ahead, shown + 1), len(segment.time))
                self._show(segment, shown - 1, hand)
                yield min(TICK, max((float(segment.time[shown - 1]) - elapsed) / speed, 0.0))
            hand.append(segment.hand)

    def png(self) -> bytes:
        """Return a picture of the present view, rendered by the browser, as a PNG file on white."""
        self._client.flush()
        width, height = PICTURE
        picture = self._client.get_render(height, width, transport_format="png", timeout=RENDER_TIMEOUT)
        image = Image.fromarray(picture).convert("RGBA")
        ground = Image.new("RGBA", image.size, "white")
        ground.alpha_composite(image)
        file = io.BytesIO()
        ground.convert("RGB").save(file, "PNG", optimize=True)
        return file.getvalue()

    def _show(self, segment: Segment, row: int, hand: list[Float]) -> None:
        """Show one instant of a segment after the hand positions of those before it."""
        with self._client.atomic():
            self._view.pose(segment.joints[row])
            path = np.concatenate((*hand, segment.hand[: row + 1]))
            self._view.show_executed(path, contact=bool(segment.contact[: row + 1].any()))
            scene = self._scene_of().batch()
            if scene.courses.any():
                self._view.show_obstacles(scene.places(segment.time[None, row : row + 1])[0, 0])
