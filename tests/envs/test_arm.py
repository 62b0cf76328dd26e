"""Arms track movements of their joints, and say clearly what they are and are not."""

import mujoco
import numpy as np
import pytest

from viapoint import primitives
from viapoint.envs.arms.arm import arm_from_xml
from viapoint.envs.arms.registry import arm_of, register_arm


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


LINKS = """
<mujoco>
  <worldbody>
    <body name="a"><joint name="one" axis="0 0 1" range="-2 2"/><geom type="{}" size="0.1 0.1 0.1" mass="1"/>
      <body name="b" pos="1 0 0"><joint name="two" axis="0 0 1" range="-2 2"/><geom size="0.1" mass="1"/>
        <site name="tip"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def small(geom="sphere"):
    limits = {"velocity_limit": (2.0, 2.0), "torque_limit": (50.0, 50.0)}
    return arm_from_xml(
        "small", LINKS.format(geom), joints=("one", "two"), tool="tip", home=(0.0, 0.0), **limits
    )


def test_collision_geoms_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match="capsules or spheres"):
        small("box")


def test_arms_are_found_by_their_names():
    arm = small()
    register_arm(arm)
    assert arm_of("small") is arm
    assert arm_of(arm) is arm
    with pytest.raises(ValueError, match="small"):
        arm_of("large")
    with pytest.raises(TypeError):
        register_arm("small")
    with pytest.raises(ValueError, match="built-in"):
        register_arm(arm_of("panda"))
