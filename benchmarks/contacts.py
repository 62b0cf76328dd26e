"""Contact in MuJoCo and negative clearance agree: random poses among obstacles of every shape, and random movements.

OMP_NUM_THREADS=1 python benchmarks/contacts.py --out docs/contacts.json
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from arm_contacts import arms

from viapoint.envs import SHAPES, ConvexMesh, register_mesh
from viapoint.envs.arms import ADULT
from viapoint.envs.arms.base import CollisionModel
from viapoint.envs.geometry.rows import shape_rows
from viapoint.envs.scenes.scene import Scenes, rest_clearance
from viapoint.envs.sim.simulator import Simulator

TOLERANCE = 1e-4
"""Clearance within which contact and its sign may differ, [m]."""
BATCH = 2000
"""Poses that are simulated together."""
KINDS = tuple(name for name, shape in SHAPES.items() if shape.in_scenes)
MESH = "hull_of_20_points"

MOVEMENTS = {"viapoint/PlanarWholeArm-v0": ("box",), "viapoint/PandaObstacles-v0": ("capsule", "box")}
"""Environments of random movements, with the shapes of their obstacles."""


class Contacts(NamedTuple):
    """Comparison of contacts with clearances."""

    poses: int
    """Poses or movements."""
    contacts: int
    wrong: int
    """Poses whose clearance is farther from 0 than TOLERANCE and has the wrong sign."""
    shallowest: float | None
    """Least depth of these, [m]; None if there are none."""


def random_obstacles(kind, places, generator):
    """Return rows of one shape near places, shape (N, D), [m], in random orientations."""
    number, d = places.shape
    half = generator.uniform(0.01, 0.15, (number, 3))
    if d == 3:
        quaternion = generator.normal(size=(number, 4))
        quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    else:
        turn = generator.uniform(-np.pi, np.pi, number)
        quaternion = np.stack((np.cos(turn / 2), 0.0 * turn, 0.0 * turn, np.sin(turn / 2)), axis=-1)
        half[:, 2] = 1.0
    shape = SHAPES[kind]
    if d == 2 and kind in ("capsule", "half_space"):  # their axes lie in the plane
        turn = 0.5 * turn
        quaternion = np.stack((np.cos(turn), -np.sin(turn), np.cos(turn), np.sin(turn)), axis=-1) * 0.5**0.5
        half[:, 2] = generator.uniform(0.0, 0.15, number)
    if shape.round:
        half[:, 1] = half[:, 0]
    half[:, 2] = {"sphere": half[:, 0], "capsule": half[:, 0] + half[:, 2]}.get(kind, half[:, 2])
    if shape.only_half is not None:
        half[:] = shape.only_half
    # The reach of a shape along a random direction, so that about half of the obstacles touch the arm.
    away = generator.normal(size=(number, d))
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    apart = generator.uniform(0.5, 2.5, (number, 1)) * (half.min(axis=-1, keepdims=True) + 0.05)
    if kind == "half_space":
        unit = shape.from_box(np.zeros((number, 3)), quaternion, half)
        away = -np.stack(unit._axes[2], axis=-1)[:, :d]
        apart = 1.0 + generator.uniform(-0.05, 0.15, (number, 1))
    return shape_rows(kind, places + apart * away, quaternion, half)


def models():
    """Return the collision models that are compared, by their names: every arm, and the hand of the planar one."""
    whole = {arm.name: CollisionModel(arm, whole_arm=True) for arm in arms()}
    return {**whole, "planar hand": CollisionModel(ADULT, whole_arm=False)}


def register_example(name=MESH):
    """Register the hull of 20 points, whose frame is neither in its middle nor along its axes of inertia."""
    points = np.random.default_rng(1).normal(size=(20, 3)) * (0.05, 0.03, 0.08) + (0.02, 0.01, 0.03)
    register_mesh(name, ConvexMesh.hull(points))
    return name


def contacts(model, kind, number, seed=0):
    """Compare contacts of an arm with obstacles of a shape."""
    generator, arm = np.random.default_rng(seed), model.arm
    low, high = (np.array(corner) for corner in arm.workspace)
    hand = low + (high - low) * generator.random((4 * number, arm.dimension))
    hand = hand[np.asarray(arm.reach_margin(hand)) > 0.0][:number]
    joints = np.asarray(arm.inverse_kinematics(hand))
    links = np.asarray(arm.links(joints))
    each, share = generator.integers(links.shape[1], size=len(hand)), generator.random((len(hand), 1))
    ends = links[np.arange(len(hand)), each]
    places = ends[:, 0] + share * (ends[:, 1] - ends[:, 0]) if model.whole_arm else hand
    rows = random_obstacles(kind, places, generator)[:, None]
    scenes = Scenes(hand, hand, rows)
    clearance = rest_clearance(scenes, hand, model)[:, 0]
    shapes = KINDS if kind in KINDS else (*KINDS, kind)
    simulator = Simulator(model, n_obstacles=1, num_envs=min(BATCH, number), threads=1, shapes=shapes)
    touched = []
    for first in range(0, len(hand), BATCH):
        some = slice(first, first + BATCH)
        sims = np.arange(len(hand[some]))
        simulator.place(sims, joints[some], rows[some], np.ones((len(sims), 1), dtype=bool))
        still = np.zeros((len(sims), 1, simulator.model.nu))
        touched.append(simulator.rollout(sims, still).contact[:, 0])
    contact = np.concatenate(touched)
    return _compared(contact, clearance)


def contacts_of_movements(env_id, shapes, number, seed=0):
    """Compare contacts in random movements, which start clear of the obstacles, with their least clearance.

    Of `number` actions, those that leave the reach count as none, as nothing moves.
    """
    envs = gym.make_vec(env_id, num_envs=min(BATCH, number), shapes=shapes)
    envs.reset(seed=seed)
    envs.action_space.seed(seed)
    found = [envs.step(envs.action_space.sample())[-1] for _ in range(-(-number // envs.num_envs))]
    contact, clearance, moved = (
        np.concatenate([info[name] for info in found]) for name in ("collision", "min_clearance", "reachable")
    )
    return _compared(contact[moved], clearance[moved])


def _compared(contact, clearance):
    """Return the comparison of contacts with clearances, shape (N,) each."""
    wrong = (contact != (clearance < 0.0)) & (np.abs(clearance) > TOLERANCE)
    shallowest = float((-clearance[wrong]).min()) if wrong.any() else None
    return Contacts(len(contact), int(contact.sum()), int(wrong.sum()), shallowest)


def main():
    """Print the comparison of all shapes, and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=10_000)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    found = {}
    found["movements"] = {}
    for env_id, shapes in MOVEMENTS.items():
        each = contacts_of_movements(env_id, shapes, arguments.poses)
        found["movements"][env_id] = each._asdict()
        print(f"{env_id}: {each.poses} movements, {each.contacts} with contact, {each.wrong} wrong")
    for name, model in models().items():
        for kind in (*KINDS, *([register_example()] if model.arm.dimension == 3 else [])):
            each = contacts(model, kind, arguments.poses)
            found.setdefault(name, {})[kind] = each._asdict()
            depth = "" if each.shallowest is None else f", the shallowest {each.shallowest:.3f} m deep"
            print(
                f"{name:12} {kind:12} {each.poses} poses, {each.contacts} contacts, {each.wrong} wrong{depth}"
            )
    if arguments.out:
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
