"""The numbers of docs/live.md are those of its JSON file."""

import json
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def read(name):
    return json.loads((DOCS / name).read_text(encoding="utf-8"))


def text(name):
    return " ".join((DOCS / name).read_text(encoding="utf-8").split())


def test_the_stated_times_of_the_live_page_are_the_measured_ones():
    plane, arm, panda = read("live.json").values()
    page = text("live.md")
    assert (
        f"medians of {plane['median_ms']} ms (`PlanarObstacles`), {arm['median_ms']} ms (`PlanarWholeArm`) and "
        f"{panda['median_ms']} ms (`PandaObstacles`)" in page
    )
    most = [f"{each['most_ms']}" for each in (plane, arm, panda)]
    assert f"95 % of the changes below {most[0]}, {most[1]} and {most[2]} ms" in page
