"""Settings for tests that start Ray, modules that tests import, order of the files, what each test finds again."""

import os
import sys
from pathlib import Path
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest

from viapoint.envs.arms import registry
from viapoint.envs.geometry.shapes import REGISTERED_MESHES
from viapoint.envs.scenes.families_registry import FAMILIES

# Ray reads this once, when it is imported; otherwise it replaces 127.0.0.1 by another address.
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"

TESTS = Path(__file__).parent
sys.path += [str(TESTS), str(TESTS.parent / "benchmarks"), str(TESTS.parent / "docs")]


FIRST = (
    *("test_agents.py", "test_site.py", "test_packaging.py", "primitives"),
    *("test_docs.py", "test_study.py", "test_live_page.py", "test_train.py", "test_cli.py"),
)
"""Files and folders that are run first: while one worker compiles the kernels of the agents, the other runs what needs
none, so that few are compiled twice; long files follow, so that no worker waits for one at the end."""


def pytest_collection_modifyitems(items):
    def place(item):
        names = {item.path.name, item.path.parent.name}.intersection(FIRST)
        return min(map(FIRST.index, names), default=len(FIRST))

    items.sort(key=place)


@pytest.fixture(autouse=True)
def registries():
    """What a test or an example registers under a name is gone afterwards, as the next may take the name."""
    with (
        patch.dict(gym.registry),
        patch.dict(REGISTERED_MESHES),
        patch.dict(FAMILIES),
        patch.dict(registry._OWN),
    ):
        yield


@pytest.fixture(scope="module")
def browser():
    from browser import Browser, chromium

    if chromium() is None:
        pytest.skip("there is no Chromium on this machine")
    browser = Browser()
    yield browser
    browser.close()


@pytest.fixture
def rng():
    """Each test begins with the same numbers, whatever ran before it."""
    return np.random.default_rng(30)
