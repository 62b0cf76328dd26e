"""Machine code on disk is used again, and is no obstacle after an update of the package."""

import subprocess
import sys

import pytest

from viapoint.envs.geometry.compiled import inner, kernel

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


@inner
def twice(number):
    return 2.0 * number


@kernel
def fourfold(number):
    return twice(twice(number))


def test_functions_for_compiled_ones_alone_refuse_calls_from_python():
    with pytest.raises(TypeError):
        twice(1.5)
    assert fourfold(1.5) == 6.0
    with pytest.raises(TypeError):
        twice(1.5)  # though it is compiled now
    assert twice.py_func(1.5) == 3.0


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
