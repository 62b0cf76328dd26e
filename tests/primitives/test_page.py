"""The page docs/primitives.md agrees with the code and with the measured numbers."""

import json
import re
from pathlib import Path

import numpy as np

from viapoint import primitives

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "primitives.md").read_text()


def test_the_example_runs_and_gives_the_durations_in_its_comment():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names = {}
    exec(code, names)
    stated = re.search(r"segment durations: \[([^]]*)\]", code).group(1)
    np.testing.assert_allclose(names["durations"], [float(n) for n in stated.split(",")], atol=5e-4)


def test_every_exported_name_is_on_the_page():
    missing = [name for name in primitives.__all__ if not re.search(rf"\b{name}\b", PAGE)]
    assert not missing


def test_the_table_of_speed_is_the_measured_file():
    rows = json.loads((DOCS / "primitives.json").read_text())
    for row in rows:
        verdict = "" if row["holds"] else " (missed)"
        limit = "" if row["limit"] is None else f"{row['limit']:.3g}{verdict}"
        line = (
            f"| {row['name']} | {row['microseconds']:.2f} | {row['value']:.3g} | {row['measure']} | {limit} |"
        )
        assert line in PAGE
    assert PAGE.count("| K=") + PAGE.count("| copy") == len(rows)
