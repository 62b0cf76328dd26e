"""Fixtures of the tests of environments: how pictures are made."""

import gymnasium as gym
import pytest
from helpers import PLANE

from viapoint.envs import renderer
from viapoint.envs.gl import GLUnavailableError


@pytest.fixture
def quick_pictures(monkeypatch):
    """Pictures without supersampling: what is tested here does not need to look good."""
    monkeypatch.setattr(renderer, "STILL_SUPERSAMPLING", 1)


@pytest.fixture(scope="session")
def opengl():
    """OpenGL, or the test is skipped."""
    env = gym.make(PLANE, render_mode="rgb_array", width=16, height=16)
    env.reset(seed=0)
    try:
        env.render()
    except GLUnavailableError as error:
        pytest.skip(f"no picture can be rendered here: {error}")
    finally:
        env.close()


@pytest.fixture
def make(opengl):
    """Function that makes environments with small pictures, which are closed after the test."""
    opened = []

    def made(name=PLANE, mode="rgb_array", *, side=96, **kwargs):
        opened.append(gym.make(name, render_mode=mode, **{"width": side, "height": side, **kwargs}))
        return opened[-1]

    yield made
    for env in opened:
        env.close()
