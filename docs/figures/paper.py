"""Draw the figures of flash-hogan.md: `python docs/figures/paper.py` writes them to docs/images/."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

from viapoint.training.evaluation import one_thread
from viapoint.training.paper.run import reproduce

FOLDER = Path(__file__).parents[1] / "images"
SHOWN = (
    "fig01_model", "fig03_straight", "fig04_joints", "fig05_height", "fig06_place", "fig08_obstacles",
    "fig10_isochrony", "valleys", "alternatives", "limits", "double_step", "double_step_jerk",
)  # fmt: skip
"""Figures of the page."""

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder, one_thread():
        for path in reproduce(Path(folder), None)[1]:
            if path.stem in SHOWN:
                small = Image.open(path).convert("RGB").quantize(64, dither=Image.Dither.NONE)
                small.save(FOLDER / f"paper_{path.name}", optimize=True)
