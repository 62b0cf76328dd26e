"""Equal seeds, equal episodes: however they are run, and as they were when their hashes were stored."""

import json
import multiprocessing

import pytest
import reliability_determinism as determinism

QUICK = 200
"""Of the thousand episodes behind the file; benchmarks/reliability_determinism.py runs all of them, every way."""


@pytest.fixture(scope="module")
def elsewhere():
    """Some episodes of every id, in another process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        found = pool.starmap(determinism.single, [(env_id, range(4)) for env_id in determinism.IDS])
    return dict(zip(determinism.IDS, found, strict=True))


@pytest.mark.parametrize("env_id", determinism.IDS)
def test_however_they_are_run(env_id, elsewhere):
    # An episode of many steps takes as long as many of one.
    number = 6 if env_id in determinism.STEP_TASKS else 16
    alone = determinism.single(env_id, range(number))
    assert len(set(alone)) == number
    assert determinism.native(env_id, range(number), 3 * number + 20) == alone  # more than one group
    assert determinism.native(env_id, range(number), 5, threads=3) == alone
    assert determinism.synchronous(env_id, range(number), 5) == alone
    assert elsewhere[env_id] == alone[: len(elsewhere[env_id])]


@pytest.mark.parametrize("env_id", determinism.IDS)
def test_they_are_what_they_were(env_id):
    stored = json.loads(determinism.FILE.read_text())
    here = determinism.fingerprint()
    others = [
        f"{name} {was} (here {here[name]})" for name, was in stored["made_with"].items() if was != here[name]
    ]
    if others:
        pytest.skip(f"the last bits of the stored hashes depend on {', '.join(others)}")
    quick = QUICK // 2 if env_id in determinism.STEP_TASKS else QUICK
    found = determinism.hashes(determinism.reference(env_id, quick))
    assert found == stored["hashes"][env_id][: len(found)], "`make hashes`, if the change is meant"
