"""Pictures and films of the live page, as bytes of files."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterable
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image

from viapoint.envs.common.types import Frame


def png(picture: Frame) -> bytes:
    """Return a picture as a PNG file on white."""
    image = Image.fromarray(picture).convert("RGBA")
    ground = Image.new("RGBA", image.size, "white")
    ground.alpha_composite(image)
    file = io.BytesIO()
    ground.convert("RGB").save(file, "PNG", optimize=True)
    return file.getvalue()


def mp4(frames: Iterable[Frame], fps: float) -> bytes:
    """Return frames of equal size, with even numbers of pixels, as an MP4 file (H.264)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        writer = None
        for frame in frames:
            if writer is None:
                height, width = frame.shape[:2]
                writer = imageio_ffmpeg.write_frames(
                    str(path), (width, height), fps=fps, codec="libx264", quality=None, bitrate=None,
                    output_params=["-crf", "20", "-movflags", "+faststart"], macro_block_size=1,
                    ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(np.ascontiguousarray(frame[..., :3]))
        if writer is None:
            raise ValueError("a film needs at least one frame")
        writer.close()
        return path.read_bytes()
