"""Arms track movements of their joints."""

import mujoco
import numpy as np
import pytest

from viapoint import primitives
from viapoint.envs.arms.registry import arm_of


@pytest.mark.parametrize("name", ["planar", "panda"])
@pytest.mark.parametrize("stride", [1, 4])
def test_movements_at_half_of_the_speed_limits_are_tracked_within_a_milliradian(name, stride):
    arm = arm_of(name)
    rng = np.random.default_rng(0)
    low, high = arm.joint_range.T
    limit = np.minimum(arm.velocity_limit, 3.0)
    model = arm.compile(0)
    data = mujoco.MjData(model)
    for _ in range(8):
        start, goal = rng.uniform(low, high, (2, len(low)))
        duration = float((1.875 * np.abs(goal - start) / (0.5 * limit)).max())
        movement = primitives.point_to_point(start, goal, duration)
        time = arm.timestep * np.arange(round(duration / arm.timestep) + 1)
        motion = [part[None] for part in movement.sample(time)]
        controls = arm.controls(*motion, stride)[0]
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        error = 0.0
        for k in range(len(time) - 1):
            data.ctrl[:] = controls[k]
            mujoco.mj_step(model, data)
            error = max(error, np.abs(data.qpos - motion[0][0, k + 1]).max())
        assert error < 1e-3
