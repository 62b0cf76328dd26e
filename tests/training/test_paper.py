"""The paper reproduced: every number of the table against its expected range, and the command with its files."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from viapoint.training.cli import entry as cli
from viapoint.training.paper import Claim, obstacles, run
from viapoint.training.paper.double_step import double_step, excess_cost
from viapoint.training.paper.movements import construction, via_waypoints
from viapoint.training.paper.run import DRAWINGS, ROWS

FEWER = 9
"""Every ninth scene of the rows of lights, so that the search takes seconds."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder that the command wrote, with fewer scenes in row 12."""
    out = tmp_path_factory.mktemp("paper")
    with pytest.MonkeyPatch.context() as patch:
        look_at_fewer_scenes(patch)
        cli.main(["paper", "--out", str(out)])
    return out


def look_at_fewer_scenes(patch):
    every = obstacles.light_scenes
    patch.setattr(obstacles, "light_scenes", lambda rows: every(rows).take(slice(None, None, FEWER)))


def claims_of(folder):
    return json.loads((folder / "table.json").read_text())["claims"]


def test_every_number_is_as_promised(made):
    claims = claims_of(made)
    assert {claim["row"] for claim in claims} == set(ROWS)
    for claim in claims:
        assert claim["model"] is not None or claim["arm"] is not None, claim
        assert claim["verdict"] == "holds", claim
    carried = [claim for claim in claims if claim["arm"] is not None]
    assert len(carried) > 0.7 * len(claims)
    assert max(claim["deviation_mm"] for claim in carried if "torque" not in claim["claim"]) < 1.0
    for name in DRAWINGS:
        assert (made / f"{name}.png").stat().st_size > 5_000


def test_the_guide_says_what_the_command_computes(made):
    text = (Path(__file__).parents[2] / "docs" / "flash-hogan.md").read_text()
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if re.match(r"\| \d", line)]
    assert len(lines) >= 10
    claims = {(claim["row"], claim["claim"]): claim for claim in claims_of(made)}
    for row, words, model, arm in lines:
        claim = claims[int(row), words]
        assert float(model) == pytest.approx(claim["model"], rel=1e-3)
        assert (arm == "-") == (claim["arm"] is None)
        if arm != "-":
            assert float(arm) == pytest.approx(claim["arm"], rel=5e-3)


@pytest.mark.parametrize(
    ("model", "arm", "holds"),
    [(1.0, 2.0, True), (1.2, 2.0, False), (1.0, 1.9, False), (np.nan, 2.0, False), (1.0, np.nan, False)],
)
def test_a_claim_holds_where_every_number_is_as_promised(model, arm, holds):
    claim = Claim(1, "x", model=(model, (0.9, 1.1)), arm=(arm, (2.0, np.inf)))
    assert claim.holds == holds


def test_a_failed_claim_ends_the_command_with_code_1(tmp_path, monkeypatch, capsys):
    claims = [Claim(1, "too much", model=(2.0, (-np.inf, 1.0)))]
    monkeypatch.setattr(run, "reproduce", lambda *_: (claims, {}))
    with pytest.raises(SystemExit) as end:
        cli.main(["paper", "--out", str(tmp_path)])
    assert end.value.code == 1
    assert "row 1, too much" in capsys.readouterr().err
    assert json.loads((tmp_path / "table.json").read_text())["holds"] is False


def test_the_agent_for_static_obstacles_meets_the_claims_of_the_search(monkeypatch):
    look_at_fewer_scenes(monkeypatch)
    claims = obstacles.obstacle_claims(obstacles.light_movements("viapoint/PlanarObstacles-v0"))
    assert [claim for claim in claims if not claim.holds] == []


def test_the_construction_is_undone():
    along, height = np.array([0.2, 0.9]), np.array([0.4, -0.3])
    found = construction(via_waypoints((0.1, -0.2), (0.4, 0.3), along, height))
    np.testing.assert_allclose(found, (along, abs(height)), atol=1e-14)


@pytest.mark.parametrize("moment", [0.04, 0.2, 0.55])
@pytest.mark.parametrize("late", [0.0, 0.1, 0.5])
def test_a_sum_of_two_movements_costs_more_than_the_plan_where_it_arrives_later(moment, late):
    movement = double_step(moment, remaining=0.7 - moment + late)
    more = movement.cost("superposed") - movement.cost("planned")
    assert more == pytest.approx(excess_cost(movement), rel=1e-9, abs=1e-9 * movement.cost("planned"))
    assert (more > 1e-3) == (late > 0.0)
    time = np.array([0.0, moment, movement.arrival + 0.1])
    for nu in range(3):
        states = movement.superposed(time, nu), movement.planned(time, nu)
        np.testing.assert_allclose(*states, atol=1e-9)
        rest = [(-0.32, 0.42), (-0.02, 0.57)] if nu == 0 else 0.0
        np.testing.assert_allclose(states[0][[0, 2]], rest, atol=1e-9)
