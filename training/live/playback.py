"""Playback of executed movements on the live page, and films and pictures of what it shows."""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from viapoint.envs.common.types import Float, Frame
from viapoint.training.io.mp4 import write_mp4
from viapoint.training.live.job_thread import TICK

if TYPE_CHECKING:
    import viser

    from viapoint.training.live.movements import Segment
    from viapoint.training.live.scene_file import LiveScene
    from viapoint.training.live.scene_view import SceneView

PICTURE = 1280, 800
"""Width and height of saved pictures and films, [pixels]."""
FILM_FPS = 25
"""Frames per second of a film."""
LINGER = 1.0
"""Time for which a film shows the end of a movement, [s]."""
RENDER_TIMEOUT = 20.0
"""Time limit of one picture from the browser, [s]."""


class Playback:
    """Playback in the view of one tab; `scene_of` returns the present scene."""

    def __init__(
        self, client: viser.ClientHandle, view: SceneView, scene_of: Callable[[], LiveScene]
    ) -> None:
        self._client, self._view, self._scene_of = client, view, scene_of
        self._hand: list[Float] = []
        self.done: list[Segment] = []
        """Segments of the last movement."""

    def play(self, segments: Iterator[Segment], speed: float) -> Iterator[float]:
        """Show a movement at a speed relative to real time, and yield the time until the next picture, [s].

        Each segment is computed when the one before it has been shown.
        """
        began = None
        for segment in self._each(segments):
            began = time.monotonic() - float(segment.time[0]) / speed if began is None else began
            shown = 0
            while shown < len(segment.time):
                elapsed = (time.monotonic() - began) * speed
                ahead = int(np.searchsorted(segment.time, elapsed))
                shown = min(max(ahead, shown + 1), len(segment.time))
                self._show(segment, shown - 1)
                yield min(TICK, max((float(segment.time[shown - 1]) - elapsed) / speed, 0.0))

    def film(self, segments: Iterator[Segment], speed: float, tell: Callable[[str], None]) -> bytes:
        """Return a movement as an MP4 file that the browser renders in the present view; `tell` shows how far it is."""
        frames, step, due = list[Any](), speed / FILM_FPS, 0.0
        for segment in self._each(segments):
            for row in np.flatnonzero(segment.time >= due):
                if segment.time[row] >= due:
                    due += step
                    self._show(segment, int(row))
                    tell(f"Rendering the film: {segment.time[row]:.2f} s of the movement so far.")
                    frames.append(self.photograph("jpeg"))
        frames += frames[-1:] * round(LINGER * FILM_FPS)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            if not write_mp4(path, (frame[..., :3] for frame in frames), FILM_FPS):
                raise ValueError("a film needs at least one frame")
            return path.read_bytes()

    def photograph(self, kind: Any) -> Any:
        """Return a picture of the present view, rendered by the browser."""
        self._client.flush()
        width, height = PICTURE
        return self._client.get_render(height, width, transport_format=kind, timeout=RENDER_TIMEOUT)

    def _each(self, segments: Iterator[Segment]) -> Iterator[Segment]:
        """Yield segments, and show their plans."""
        self.done, self._hand = [], []
        for segment in segments:
            if segment.restarted:
                self._hand = []
            if segment.path is not None:
                self._view.show_plan(segment.path, np.zeros((0, segment.hand.shape[-1])), clear=True)
            self.done.append(segment)
            yield segment
            self._hand.append(segment.hand)

    def _show(self, segment: Segment, row: int) -> None:
        """Show one instant of a segment."""
        with self._client.atomic():
            self._view.pose(segment.joints[row])
            path = np.concatenate((*self._hand, segment.hand[: row + 1]))
            self._view.show_executed(path, contact=bool(segment.contact[: row + 1].any()))
            scene = self._scene_of().batch()
            if scene.courses.any():
                self._view.show_obstacles(scene.places(segment.time[None, row : row + 1])[0, 0])


def png(picture: Frame) -> bytes:
    """Return a picture as a PNG file on white."""
    image = Image.fromarray(picture).convert("RGBA")
    ground = Image.new("RGBA", image.size, "white")
    ground.alpha_composite(image)
    file = io.BytesIO()
    ground.convert("RGB").save(file, "PNG", optimize=True)
    return file.getvalue()
