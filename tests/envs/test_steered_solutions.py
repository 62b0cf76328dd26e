"""Nothing is lost by an action in every control step: steered along a movement that succeeds, the hand succeeds."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from scene_numbers import steered


@pytest.mark.parametrize("name", ["viapoint/PlanarObstaclesStep-v0", "viapoint/PandaObstaclesStep-v0"])
def test_steered_along_solutions_of_the_twin_the_hand_succeeds(name):
    found = steered(name, 40)
    assert found["success"] == 1.0
    assert found["of_solutions"] < found["jerk_ratio"] < 15.0
