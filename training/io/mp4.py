"""MP4 files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from viapoint.envs.common.types import Frame
from viapoint.training.io.files import MARK


def write_mp4(path: Path, frames: Iterable[Frame], fps: float) -> int:
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
