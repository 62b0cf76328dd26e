"""Tasks by short names, with scenes and problems of them."""

import numpy as np

from viapoint.training.planning.problem import Problem

PLANE, REACH, STEP, WHOLE, PANDA = (
    f"viapoint/{name}-v0"
    for name in ("PlanarObstacles", "PlanarReach", "PlanarObstaclesStep", "PlanarWholeArm", "PandaObstacles")
)
MOVING, JUMPS, SENSED = (
    f"viapoint/{name}-v0" for name in ("PlanarMovingObstacles", "PlanarTargetJump", "PlanarSensed")
)


def scenes_of(task, number, seed=0):
    """Draw scenes, each with a generator of its own."""
    return task.sampler()([np.random.default_rng((seed, each)) for each in range(number)])


def problem_of(task, number, seed=0):
    return Problem.of_scenes(scenes_of(task, number, seed), task)
