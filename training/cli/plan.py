"""Command `plan`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from viapoint.envs.arms.arm import Arm
from viapoint.envs.arms.load import load_arm
from viapoint.envs.arms.registry import arm_names, arm_of
from viapoint.envs.geometry.shapes import obstacles_from_json
from viapoint.envs.scenes.options import Pose, scene_from_json
from viapoint.training.configs import PlanConfig
from viapoint.training.files import LARGEST_JSON, BadFileError, read_bytes
from viapoint.training.planning.export import read_motion, write_motion
from viapoint.training.planning.plan_motion import plan_motion
from viapoint.training.planning.search import registered_task

# Flags that are arguments of load_arm
LOADING = ("tool", "joints", "base", "packages", "velocity_limit", "torque_limit")


def run(config: PlanConfig) -> None:
    """Plan a movement, print what is known of it, and write it."""
    if config.out is not None:
        _check_replaceable(config.out)
    arm = _arm_for(config)
    if not any((config.start, config.goal, config.position, config.scene, config.out, config.video)):
        print(arm.report())
        return
    _check_lengths(config, arm)
    scene = _scene(config.scene, arm)
    start = config.start or scene.get("start")
    if start is None:
        start = arm.hand(arm.home)[:2] if arm.space == "hand" else arm.home
    plan = plan_motion(
        arm,
        start,
        _goal(config, scene),
        scene.get("obstacles", ()),
        n_via=config.n_via,
        margin=config.margin,
        duration=config.duration,
        time_limit=config.time_limit,
        rng=config.seed,
    )
    print(plan)
    if not plan.success and not config.force:
        raise ValueError(f"no plan is safe: {plan.reason}; --force writes it nevertheless")
    if config.out is not None:
        motion = write_motion(plan, config.out, config.rate, force=config.force)
        print(f"{len(motion.time)} instants at {config.rate:g} Hz: {config.out}")
    if config.video is not None:
        from viapoint.training.video import record_plan

        print(f"{record_plan(config.video, plan)} frames: {config.video}")


def _check_replaceable(path: Path) -> None:
    """Check that there is no file yet, or a movement, which was written by an earlier call."""
    try:
        if path.exists():
            read_motion(path)
    except (OSError, ValueError):
        raise BadFileError(path, "exists and holds no movement; name another file, or move it away") from None


def _arm_for(config: PlanConfig) -> Arm:
    """Return the arm of a name or of a file."""
    given = {name: getattr(config, name) for name in LOADING if getattr(config, name) not in ("", (), None)}
    if not given and (config.arm in arm_names() or not Path(config.arm).expanduser().is_file()):
        return arm_of(config.arm)
    if config.arm in arm_names():
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in given)
        raise ValueError(f"{flags} is for an arm of a file, got --arm {config.arm}")
    return load_arm(config.arm, **given)


def _check_lengths(config: PlanConfig, arm: Arm) -> None:
    """Check how many numbers the ends of the movement have."""
    ends = (2, "x y") if arm.space == "hand" else (len(arm.joint_names), "joint positions")
    expected = {"start": ends, "goal": ends, "position": (3, "x y z"), "quaternion": (4, "w x y z")}
    for name, (length, meaning) in expected.items():
        given = len(getattr(config, name))
        if given not in (0, length):
            raise ValueError(f"--{name} needs {length} numbers for {arm.name}, {meaning}, got {given}")


def _scene(path: Path | None, arm: Arm) -> dict[str, Any]:
    """Return start, goal and obstacles of a scene file, or of a list of obstacles; ends of another arm are refused."""
    if path is None:
        return {}
    content = read_bytes(path, LARGEST_JSON)
    try:
        text = content.decode("utf-8-sig")
        if text.lstrip().startswith("["):
            return {"obstacles": obstacles_from_json(text)}
        scene = scene_from_json(text)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    env_id = json.loads(text).get("env")
    if env_id and {"start", "goal"} & scene.keys():
        other = registered_task(env_id).arm
        if other.name != arm.name:
            raise ValueError(f"{path} has ends of the arm {other.name} ({env_id}), not of {arm.name}")
    changes = [name for name in ("jumps", "turns", "reaches") if scene.get(name)]
    if changes:
        raise ValueError(f"{path} has {', '.join(changes)}: a plan is for one goal and constant velocities")
    return scene


def _goal(config: PlanConfig, scene: dict[str, Any]) -> Any:
    """Return the goal: coordinates, or a pose."""
    if config.position:
        return Pose(np.array(config.position), config.quaternion or None)
    if config.goal:
        return config.goal
    if "goal" in scene:
        return scene["goal"]
    raise ValueError("name a goal: --goal JOINTS, or --position X Y Z, or a scene file that has one")
