"""What `viapoint paper` does."""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image
from tqdm import tqdm

from viapoint.training import train as training
from viapoint.training.config import PaperConfig
from viapoint.training.paper.obstacles import check_agent
from viapoint.training.paper.report import summary, write
from viapoint.training.paper.reproduce import STEPS, Reproduction, reproduce

IN_THE_GUIDE = (
    "fig01_model", "fig03_straight", "fig04_joints", "fig05_height", "fig06_place", "fig08_obstacles",
    "fig10_isochrony", "valleys", "alternatives", "limits", "double_step", "double_step_jerk",
)  # fmt: skip
"""The figures that docs/flash-hogan.md shows."""


class ClaimsFailedError(Exception):
    """Some claims do not hold; what was computed is written all the same."""

    exit_code = 1


def run(config: PaperConfig) -> None:
    """Compute, draw, write, and end with an error if a verdict fails.

    Raises:
        ValueError: There is no such agent, or it cannot move around the paper's lights; nothing is computed.
        ClaimsFailedError: A claim does not hold.
    """
    if config.agent is not None:
        check_agent(config.agent)
    with tqdm(total=STEPS, file=sys.stderr, dynamic_ncols=True, unit=" steps") as bar, training.one_thread():

        def tell(name: str) -> None:
            bar.set_description(name)
            bar.update()

        result = reproduce(config.out, config.agent, tell)
    pages = write(result, config.out)
    if config.guide is not None:
        write_guide(result, config.guide)
    print(f"{summary(result.claims)} The page: {pages[-1]}")
    if result.failed:
        names = "; ".join(f"row {claim.row}, {claim.claim}" for claim in result.failed)
        raise ClaimsFailedError(f"{len(result.failed)} of {len(result.claims)} claims fail: {names}")


def write_guide(result: Reproduction, folder: Path) -> None:
    """Small versions of the figures for the guide: paper_*.png with few colours."""
    folder.mkdir(parents=True, exist_ok=True)
    for path, _ in result.pictures:
        if path.stem in IN_THE_GUIDE:
            small = Image.open(path).convert("RGB").quantize(64, dither=Image.Dither.NONE)
            small.save(folder / f"paper_{path.name}", optimize=True)
