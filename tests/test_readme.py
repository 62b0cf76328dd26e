"""The examples of the README run as they stand, and its numbers are those of the study."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
STUDY = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
ROWS = {
    "viaq, learned alone": ("viaq", "alone"),
    "viaq, 64 checks": ("viaq", "checked"),
    "viaq untrained, 64 checks": ("viaq", "untrained"),
    "search without learning, 16 checks": ("search16", None),
    "search without learning, 512 checks": ("search512", None),
    "SAC": ("sac", "alone"),
    "TQC": ("tqc", "alone"),
    "TD3": ("td3", "alone"),
    "PPO": ("ppo", "alone"),
    "PPO, an action in every control step": ("ppo-step", "alone"),
    "best of 80 random actions, each simulated": ("random80", None),
    "motion planner from a library (OMPL's RRT-Connect, made smooth)": ("ompl", None),
}


def test_the_examples_of_the_readme_run(capsys):
    names = {}
    for example in re.findall(r"```python\n(.*?)```", README, re.DOTALL):
        exec(example, names)
    assert capsys.readouterr().out.startswith("True ")  # the shipped agent succeeds
    assert names["result"].success_rate >= 0.9
    names["env"].close()
    names["envs"].close()
    assert names["position"].shape == (100, 2)
    assert names["movement"].sample(100)[0].shape == (100, 2)


def test_the_links_of_the_readme_exist():
    for target in re.findall(r"\]\(([^)#]+)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target


def success(measured):
    rate, low, high = (f"{100 * part:.1f}".replace("100.0", "100") for part in measured["success"])
    return f"{rate} % ({low}-{high})"


@pytest.mark.parametrize("label", ROWS)
def test_the_table_of_the_study_is_that_of_its_file(label):
    name, how = ROWS[label]
    results = STUDY["environments"]["viapoint/PlanarObstacles-v0"]
    (method,) = (each for each in results["methods"] + results["baselines"] if each["name"] == name)
    test, hard = (method["sets"][each][how] if how else method["sets"][each] for each in ("test", "hard"))
    learnt = [f"{method['training']['decisions']:,}", str(len(method["seeds"]))] if how else ["-", "-"]
    jerk = test["jerk"][0]
    cells = [label, *learnt, success(test), success(hard), f"{jerk:.0f}" if jerk >= 100.0 else f"{jerk:.2f}"]
    assert f"| {' | '.join(cells)} |" in README
