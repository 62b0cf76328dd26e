"""Time from a change on the live page to the message with the new plan: `python benchmarks/live.py [--json FILE]`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch

from viapoint.training.live.page import LivePage

INWARDS = {
    "viapoint/PlanarObstacles-v0": (-0.05, 0.38, 0.0),
    "viapoint/PlanarWholeArm-v0": (-0.05, 0.38, 0.0),
    "viapoint/PandaObstacles-v0": (0.3, 0.0, 0.5),
}
"""Environments, and a place in the middle of the arm's reach, [m]."""
DRAGS, STEPS = 4, 10
"""Number of drags, and of positions in each."""
DISTANCE = 0.03
"""Length of a drag along each horizontal axis, [m]."""


def main() -> None:
    """Drag the goal to and fro in a headless Chromium, and print the latencies of the server, or write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    file, found = parser.parse_args().json, {}
    tests = Path(__file__).parents[1] / "tests"
    sys.path += [str(tests), str(tests / "training")]
    import browser
    from test_live_page import on_screen, steady

    torch.set_num_threads(1)  # as the command `viapoint live` does
    window = browser.Browser()
    print("environment, changes, median [ms], 95 % [ms]")
    for env_id, middle in INWARDS.items():
        with LivePage(env=env_id, port=0, seed=11) as page:
            tab = window.tab(page.url)
            (session,) = browser.wait_for(lambda page=page: page.tabs)
            browser.wait_for(lambda s=session: s.idle and s.state.plan)
            browser.wait_for(lambda t=tab: steady(t))
            tool = session.arena.tool
            goal = tool(session.state.scene.goal)
            other = goal + DISTANCE * np.sign(middle - goal) * (1.0, 1.0, 0.0)
            for k in range(DRAGS):
                ends = tool(session.state.scene.goal), (other, goal)[k % 2]
                tab.drag(*(on_screen(tab, session, place) for place in ends), steps=STEPS)
                time.sleep(0.3)
                browser.wait_for(lambda s=session: s.idle)
            taken = 1e3 * np.array(session.latencies)
            median, most = float(np.median(taken)), float(np.quantile(taken, 0.95))
            print(f"{env_id}, {len(taken)}, {median:.0f}, {most:.0f}")
            found[env_id] = {"changes": len(taken), "median_ms": round(median, 1), "most_ms": round(most, 1)}
            tab.close()
    window.close()
    if file is not None:
        file.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
