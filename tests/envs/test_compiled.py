"""Machine code on disk is used again, and is no obstacle after an update of the package."""

import subprocess
import sys

RECORD = """
from typing import NamedTuple

class Length(NamedTuple):
    metres: float
"""
FUNCTION = """
from {module} import Length
from viapoint.envs.geometry.compiled import compiled

@compiled
def doubled(length):
    return 2.0 * length.metres
"""
USE = (
    "from caller import Length, doubled; print(doubled(Length(1.5)), sum(doubled.stats.cache_hits.values()))"
)


def test_records_may_move_to_another_module(tmp_path):
    """As in an update of the package: the machine code of before names a module that is gone."""
    found = []
    (tmp_path / "before.py").write_text(RECORD)
    for module in ("before", "before", "after"):
        if module == "after":
            (tmp_path / "before.py").rename(tmp_path / "after.py")
        (tmp_path / "caller.py").write_text(FUNCTION.format(module=module))
        done = subprocess.run([sys.executable, "-c", USE], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout.split())
    assert [value for value, _ in found] == ["3.0"] * 3
    assert found[2][1] == "0"
