"""Gymnasium environments whose actions are via-points and durations; importing registers them.

See :data:`viapoint.envs.registration.TASKS` for the ids.
"""

from viapoint.envs.common import mujoco_check as mujoco_check
from viapoint.envs.registration import TASKS, register_all

register_all()

__all__ = ["TASKS"]
