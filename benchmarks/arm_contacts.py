"""Measure arms: agreement of clearance with contact in MuJoCo, and the clearance of an arm from itself.

    OMP_NUM_THREADS=1 python benchmarks/arm_contacts.py --out docs/arm-contacts.json

Columns:

    capsules   capsules and spheres of the links
    poses      random configurations within the joint ranges, each with an obstacle; half of the obstacles are within
               5 mm of contact
    contacts   poses in which MuJoCo reports contact: with the obstacle, the arm itself or the table
    wrong      poses whose contact differs from the sign of the clearance, if that is over 0.1 mm
    worst      greatest clearance of all poses whose contact differs from its sign, [mm]
    reach      least clearance of the arm from itself and the table within reach, [mm]
    touching   share of the positions within reach at which it is negative, [%]
    excess     greatest distance of a point of a fitted capsule from the geom that it covers, [mm]; 0 without such
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is loaded

import argparse
import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from viapoint.envs import load_arm
from viapoint.envs.arms import ADULT, PANDA, Arm
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.arms.serial_arm import SerialArm
from viapoint.envs.common.types import Bool, Float
from viapoint.envs.sim.simulator import Simulator

BLOCK = 1000
"""Poses that are simulated together."""
NEAR = 0.005
"""Clearance within which half of the obstacles are, [m]."""
CONTACT_TOLERANCE = 1e-4
"""Clearance below which contact may differ, [m]."""
REACH_POSITIONS = 1_000_000
"""Random positions of the hand, of which those within reach are checked."""
ROOT = Path(__file__).parents[1]


def arms() -> list[Arm]:
    """Return the arms of the package, the arm of docs/ur5e.xml and, if gymnasium-robotics is installed, Fetch."""
    names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    ur5e = load_arm(
        ROOT / "docs" / "ur5e.xml", hand_site="hand", joints=names, velocity_limit=np.pi,
        home=(0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28),
    )  # fmt: skip
    package = find_spec("gymnasium_robotics")
    if package is None or not package.submodule_search_locations:
        return [ADULT, PANDA, ur5e]
    names = (
        "shoulder_pan",
        "shoulder_lift",
        "upperarm_roll",
        "elbow_flex",
        "forearm_roll",
        "wrist_flex",
        "wrist_roll",
    )
    fetch = load_arm(
        Path(package.submodule_search_locations[0]) / "envs" / "assets" / "fetch" / "reach.xml",
        name="fetch", hand_site="robot0:grip", joints=[f"robot0:{name}_joint" for name in names],
        joint_range=[(-1.6, 1.6), (-1.2, 1.5), (-3.1, 3.1), (-2.2, 2.2), (-3.1, 3.1), (-2.1, 2.1), (-3.1, 3.1)],
        torque_limit=(33.8, 131.7, 76.9, 66.1, 29.3, 25.7, 7.3), home=(0.0, -0.5, 0.0, 1.3, 0.0, 0.77, 0.0),
    )  # fmt: skip
    return [ADULT, PANDA, ur5e, fetch]


def random_poses(arm: Arm, number: int, generator: np.random.Generator) -> tuple[Float, Float, Float]:
    """Return configurations (N, J), an obstacle for each (N, 1, 2 D + 1), and their clearance (N,)."""
    d, present = arm.dimension, np.ones((number, 1), dtype=bool)
    joints = generator.uniform(*np.array(arm.joint_range).T, (number, len(arm.joint_range)))
    links = np.asarray(arm.links(joints))
    some = links[np.arange(number), generator.integers(links.shape[1], size=number)].mean(axis=1)
    centre = some + generator.uniform(-0.2, 0.2, (number, d))
    axis = generator.uniform(-0.15, 0.15, (number, d)) * (generator.random((number, 1)) < 0.7)
    rows = np.concatenate((centre, axis, generator.uniform(0.01, 0.05, (number, 1))), axis=-1)[:, None]
    clearance = clearance_of(arm, joints, rows, present)
    moved = rows[:, 0, -1] + clearance - generator.uniform(-NEAR, NEAR, number)
    rows[:, 0, -1] = np.where(
        (np.arange(number) % 2 == 0) & (moved > NEAR) & (moved < 0.3), moved, rows[:, 0, -1]
    )
    return joints, rows, np.minimum(clearance_of(arm, joints, rows, present), arm.self_clearance(joints))


def clearance_of(arm: Arm, joints: Float, rows: Float, present: Bool) -> Float:
    """Return the clearance of configurations from their obstacles, shape (N,), [m]."""
    hand = np.asarray(arm.hand_position(joints))[:, None]
    return CollisionModel(arm, True).least_clearance(hand, rows, present, joints[:, None])


def agreement(arm: Arm, number: int, generator: np.random.Generator) -> dict[str, Any]:
    """Compare the signs of clearances with contact in MuJoCo."""
    simulator = Simulator(CollisionModel(arm, True), n_obstacles=1, num_envs=BLOCK, threads=1)
    sims, contacts, clearances = np.arange(BLOCK), [], []
    for _ in range(0, number, BLOCK):
        joints, rows, clearance = random_poses(arm, BLOCK, generator)
        simulator.place(sims, joints, rows, np.ones((BLOCK, 1), dtype=bool))
        contacts.append(simulator.rollout(sims, np.zeros((BLOCK, 1, simulator.model.nu))).contact[:, 0])
        clearances.append(clearance)
    contact, clearance = np.concatenate(contacts), np.concatenate(clearances)
    off = np.abs(clearance) * (contact != (clearance < 0.0))
    return {
        "poses": len(off),
        "contacts": int(contact.sum()),
        "wrong": int((off > CONTACT_TOLERANCE).sum()),
        "worst": round(1e3 * float(off.max()), 5),
    }


def within_reach(arm: Arm, generator: np.random.Generator) -> dict[str, Any]:
    """Return the least clearance of an arm from itself within reach, and the share of positions with a negative one."""
    hand = generator.uniform(-1.0, 1.0, (REACH_POSITIONS, arm.dimension))
    if isinstance(arm, SerialArm):
        hand[:, 2] = np.abs(hand[:, 2])
    hand = hand[np.asarray(arm.reach_margin(hand)) >= 0.0]
    clearance = np.asarray(arm.self_clearance(arm.inverse_kinematics(hand)))
    return {
        "reach": round(1e3 * float(clearance.min()), 2),
        "touching": round(100.0 * float((clearance < 0).mean()), 2),
    }


def main() -> None:
    """Print a row for each arm, and write them to a file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=10_000, help="poses of each arm, a multiple of 1,000")
    parser.add_argument("--out", type=Path, help="JSON file of the results")
    options = parser.parse_args()
    found = []
    for arm in arms():
        generator = np.random.default_rng(0)
        row = {"arm": arm.name, "capsules": len(arm.link_radii), **agreement(arm, options.poses, generator)}
        row |= within_reach(arm, generator)
        if isinstance(arm, SerialArm):
            row["excess"] = round(1e3 * max(capsule.excess for capsule in arm.shape), 1)
        found.append(row)
        print("  ".join(f"{name} {value}" for name, value in row.items()), flush=True)
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
