"""Picture of the live page for docs/live.md, from a headless Chromium."""

from __future__ import annotations

import io
import sys
import time
from pathlib import Path

from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from viapoint.training.live.page import LivePage

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
SIZE = 1320, 850
"""Size of the window, [pixels]."""
SEED, OBSTACLE = 3, 8
"""Seed of the scene, and the obstacle that has a number."""
LEFT, RIGHT = 352, 988
"""Columns of the numbers beside the panels, [pixels]."""
PANELS = (
    (LEFT, 100),
    (LEFT, 350),
    (RIGHT, 110),
    (RIGHT, 152),
    (RIGHT, 215),
    (RIGHT, 342),
    (RIGHT, 507),
)
"""Places of the numbers of the panels' parts, [pixels]."""
ASIDE, RADIUS = 26, 16
"""Distance of the via-point's number from it to the right and down, and radius of numbers, [pixels]."""


def main() -> None:
    """Write the picture."""
    sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "training")]
    import browser
    from test_live_page import on_screen, steady

    browser.SIZE = SIZE
    window = browser.Browser()
    with LivePage("viapoint/PandaObstacles-v0", port=0, seed=SEED) as page:
        tab = window.tab(page.url)
        tab.call(
            "Emulation.setDeviceMetricsOverride",
            width=SIZE[0],
            height=SIZE[1],
            deviceScaleFactor=1,
            mobile=False,
        )
        (session,) = browser.wait_for(lambda: page.tabs)
        browser.wait_for(lambda: session.idle and session.state.plan)
        tab.run(
            "document.querySelectorAll('.mantine-Notification-closeButton').forEach(each => each.click())"
        )
        time.sleep(1.0)
        browser.wait_for(lambda: steady(tab))
        via = on_screen(tab, session, session.arena.tool(session.state.plan.waypoints[1]))
        obstacle = on_screen(tab, session, session.state.scene.obstacles[OBSTACLE].position)
        plain = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
    window.close()
    marked, font = plain.copy(), ImageFont.truetype(findfont("DejaVu Sans:bold"), 20)
    draw = ImageDraw.Draw(marked)
    beside_via = via[0] + ASIDE, via[1] + ASIDE
    for number, place in enumerate((*PANELS, beside_via, obstacle), start=1):
        draw.circle(place, RADIUS, fill=(20, 33, 69), outline="white", width=2)
        draw.text(place, str(number), fill="white", font=font, anchor="mm")
    marked.save(IMAGES / "live_annotated.webp", quality=82, method=6)


if __name__ == "__main__":
    main()
