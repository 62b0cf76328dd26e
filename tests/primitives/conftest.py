"""Random numbers of the tests: each test begins with the same, whatever ran before it."""

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(30)
