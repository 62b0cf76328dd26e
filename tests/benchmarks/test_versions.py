"""The bounds of the dependencies are those that docs/reliability.md says the suite passed with."""

import re
from pathlib import Path

import versions

ROOT = Path(__file__).parents[2]


def test_bounds_are_the_versions_that_were_tried():
    page = (ROOT / "docs" / "reliability.md").read_text()
    rows = re.findall(r"^\| ([a-z0-9-]+) \| ([0-9.]+) \| ([0-9.]+) \|$", page, flags=re.MULTILINE)
    assert {name: oldest for name, oldest, _ in rows} == versions.lower_bounds()
    pinned = (ROOT / "constraints.txt").read_text().lower().replace("_", "-")
    for name, _, newest in rows:
        assert f"{name}=={newest}" in pinned.splitlines(), name
