"""The numbers of docs/geometry.md are those of its JSON files."""

import json
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "geometry.md").read_text(encoding="utf-8")
TEXT = " ".join(PAGE.split())
FOUND = json.loads((DOCS / "geometry.json").read_text(encoding="utf-8"))
CONTACTS = json.loads((DOCS / "contacts.json").read_text(encoding="utf-8"))


def scientific(number):
    return f"{number:.1e}".replace("e-0", "e-")


def test_the_stated_differences_are_the_greatest_measured_ones():
    rows = FOUND["agreement"]
    coal, mujoco = (scientific(max(row[name] for row in rows)) for name in ("coal", "mujoco"))
    assert f"from those of coal by at most {coal} m and from those of MuJoCo by at most {mujoco} m" in TEXT
    mesh, others = (
        scientific(max(row["depth"] for row in rows if (row["shape"] == "convex_mesh") == is_mesh))
        for is_mesh in (True, False)
    )
    assert f"from those of MuJoCo by at most {mesh} m for meshes and {others} m for other shapes" in TEXT


def test_the_stated_misses_of_contact_are_all_of_them():
    missed = {(row["shape"], row["probe"]): row["wrong"] + row["through"] for row in FOUND["agreement"]}
    number = missed.pop(("box", "capsules"))
    assert not any(missed.values())
    assert {row["poses"] for row in FOUND["agreement"]} == {10_000}
    assert f"pass right through a box ({number} of 10,000)" in TEXT
    wrong = {(arm, shape): row["wrong"] for arm, rows in CONTACTS.items() for shape, row in rows.items()}
    arm, panda = (
        CONTACTS["movements"][f"viapoint/{task}-v0"] for task in ("PlanarWholeArm", "PandaObstacles")
    )
    assert (
        f"in {arm['poses']:,} random movements of `PlanarWholeArm` among boxes, {arm['contacts']:,} of them"
        in TEXT
    )
    assert f"so they do in {panda['poses']:,} movements in `PandaObstacles`" in TEXT
    assert list(CONTACTS)[1:] == ["planar", "panda", "ur5e", "fetch", "planar hand"]
    assert {row["poses"] for row in CONTACTS["planar"].values()} == {10_000}
    boxes = {arm: CONTACTS[arm]["box"]["shallowest"] for arm in ("planar", "ur5e")}
    assert wrong.pop(("ur5e", "box")) == 1
    assert f"{wrong.pop(('planar', 'box'))} poses of the planar arm and one of UR5e differ" in TEXT
    assert not any(wrong.values())
    assert f"the clearance is below -{int(1e3 * min(boxes.values()))} mm" in TEXT


def test_the_stated_times_are_the_measured_ones():
    lines = PAGE.splitlines()
    shapes = list(dict.fromkeys(row["shape"] for row in FOUND["times"]))
    assert f"| time [ns] | {' | '.join(shapes)} |" in lines
    for probe, name in (("spheres", "points"), ("capsules", "segments")):
        times = [f"{row['engine']:.0f}" for row in FOUND["times"] if row["probe"] == probe]
        assert f"| {name} | {' | '.join(times)} |" in lines
    ratios = [row["engine"] / row["plain"] for row in FOUND["times"] if row["plain"]]
    assert f"That is {min(ratios):.2f} to {max(ratios):.2f} times the time of the same formulas" in TEXT
