"""Numbers that pages state are those of the JSON files of their measurements."""

import json
import statistics
from pathlib import Path

import pytest

from viapoint.training.scene_sets.scene_set import load

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
    assert f"these are {plane['changes']}, {arm['changes']} and {panda['changes']} of 41 changes" in page


def test_the_stated_numbers_of_steered_movements_are_the_measured_ones():
    plane, fine, panda = read("scenes.json")["steered"].values()
    assert all(each["success"] == 1.0 for each in (plane, fine, panda))
    page = text("environments-step.md")
    assert (
        f"a median jerk ratio of {plane['jerk_ratio']:.1f} (the solutions: {plane['of_solutions']:.1f}; "
        f"with `control_step=0.02`: {fine['jerk_ratio']:.1f})" in page
    )
    assert f"with {panda['jerk_ratio']:.1f} (the solutions: {panda['of_solutions']:.1f};" in page


def test_the_stated_numbers_of_uniform_scenes_left_out_are_those_of_the_sets():
    drawn = {env_id: int(load("uniform", env_id).number.max()) + 1 for env_id in read("scenes.json")["drawn"]}
    assert drawn == read("scenes.json")["drawn"]
    stated = [f"{number - 500} of {number}" for number in drawn.values()]
    assert "{} in `PlanarObstacles`, {} in `PlanarWholeArm` and {} in `PandaObstacles`".format(
        *stated
    ) in text("environments.md")


def test_the_stated_numbers_of_scenes_with_a_desk_are_the_measured_ones():
    alone, checked, *searches = read("scenes.json")["desk"].values()
    assert [checked, *searches] == [1.0] * 3
    assert (
        f"the shipped agent succeeds in {100 * alone:.1f} %, and with 64 checks in 100 %, as do `search64` and "
        "`search512`" in text("environments-panda.md")
    )


def test_the_stated_numbers_of_shown_benchmark_problems_are_those_of_the_file():
    file = DOCS.parent / "training" / "live" / "motion_bench_maker.json"
    shown = json.loads(file.read_text(encoding="utf-8"))["can be shown, of 100"]
    assert f"Of {100 * len(shown)} problems, {sum(shown.values())} can be shown" in text("live.md")
    assert [name for name, number in shown.items() if not number] == ["box", "table_under_pick"]


def total(results, part, name):
    return sum(each[part].get(name, 0) for each in results.values())


def test_the_stated_numbers_of_killed_trainings_are_the_measured_ones():
    runs = read("reliability/kill.json").values()
    kills, writing, number = (sum(each[name] for each in runs) for name in ("kills", "amid a write", "runs"))
    assert not any(each["differing"] or each["checkpoints passed over"] for each in runs)
    stated = (
        f"killed {kills} times by SIGKILL at random moments, {writing} times amid a write: none of {number} "
    )
    assert stated + "results differs" in text("reliability.md")


def test_the_stated_numbers_of_episodes_from_equal_seeds_are_the_measured_ones():
    results = read("reliability/determinism.json")
    assert not any(number for each in results.values() for number in each["differ"].values())
    assert {len(each["differ"]) for each in results.values()} == {6}
    steps = {name: each["episodes"] for name, each in results.items() if "Step-" in name}
    others = {name: each["episodes"] for name, each in results.items() if name not in steps}
    assert (len(others), set(others.values())) == (8, {1000})
    assert (len(steps), set(steps.values())) == (3, {100})
    assert "0 of 1,000 episodes of each of the eight ids" in text("reliability.md")
    assert "0 of 100 of each of the three step-wise ids" in text("reliability.md")


def test_the_stated_numbers_of_fuzzing_are_the_measured_ones():
    results, page = read("reliability/fuzz.json"), text("reliability.md")
    actions, refused, unstable = (
        total(results, "actions", name) for name in ("actions", "refused", "unstable")
    )
    assert not unstable
    assert f"in each of {len(results)} ids: {actions:,} steps, {refused} refusals, none unstable" in page
    played, refused = (total(results, "scenes", name) for name in ("played", "refused"))
    assert f"10,000 in each of {len(results)} ids: {played:,} played, {refused:,} refused" in page
    done, refused = (total(results, "calls", name) for name in ("done", "refused"))
    assert f"5,000 in each of {len(results)} ids: {done:,} done, {refused:,} refused" in page
    assert not total(results, "calls", "refused without a reason")
    most = max(part["memory_growth"] for each in results.values() for part in each.values())
    assert f"at most {most} MB above" in page


@pytest.mark.parametrize("part", ["decisions", "cycles"])
def test_the_stated_memory_is_the_measured_one(part):
    result, page = read(f"reliability/{part}.json"), text("reliability.md")
    end = result["curve"][-1]
    assert (result["files_growth"], result["threads_growth"]) == (0, 0)
    assert f"{result['memory_growth']:+.1f} MB of {end['memory']:.0f} MB after the first tenth" in page
    if part == "decisions":
        first, last = result["first_speed"], result["last_speed"]
        assert f"{first:.0f} a second of processor time at first and {last:.0f} at last" in page


def test_comparisons_of_the_page_of_results_are_those_of_its_rows():
    for environment in read("results.json")["environments"].values():
        rows = {each["row"]: each["sets"] for each in environment["rows"]}
        for pair in environment["compared"]:
            for name, found in pair["sets"].items():
                first, second = (rows[pair[side]][name]["each"] for side in ("first", "second"))
                if "difference" in found:
                    differences = [each - second[0] for each in first]
                    stated = [statistics.median(differences), min(differences), max(differences)]
                    assert found["difference"] == pytest.approx(stated, abs=1e-5)
                else:
                    assert found["pairs"] == len(first) * len(second)
