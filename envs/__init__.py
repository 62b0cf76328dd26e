"""Gymnasium environments whose actions are via-points and durations; importing registers them.

See :data:`viapoint.envs.registration.TASKS` for the ids.
"""

from viapoint.envs import _mujoco as _mujoco
from viapoint.envs.registration import TASKS, register_all

register_all()

__all__ = ["TASKS"]
