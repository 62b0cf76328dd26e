"""Contacts of arms with themselves, by spheres and by MuJoCo."""

import itertools

import mujoco
import numpy as np

from viapoint.envs.arms.kinematics import sphere_centres


def least_pair_distance(arm, joints):
    """Least signed distance of spheres of each compared pair of groups, shape (..., P), [m]."""
    spheres, centres = arm.spheres, sphere_centres(arm.chain, arm.spheres, joints)
    some = [slice(*ends) for ends in itertools.pairwise(spheres.first)]
    found = []
    for a, b in spheres.pairs:
        apart = np.linalg.norm(centres[..., some[a], None, :] - centres[..., None, some[b], :], axis=-1)
        found.append((apart - spheres.radius[some[a], None] - spheres.radius[some[b]]).min(axis=(-2, -1)))
    return np.stack(found, axis=-1) if found else np.empty((*joints.shape[:-1], 0))


def check_contact_implies_overlap(arm, number=3000):
    """Compare with the contacts that MuJoCo finds in the arm's own model, in both directions of the promise."""
    model = arm.compile(0)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    joints = rng.uniform(*arm.joint_range.T, (number, len(arm.joint_names)))
    distance = least_pair_distance(arm, joints)
    pairs = {
        frozenset((arm.group_names[a], arm.group_names[b])): i for i, (a, b) in enumerate(arm.spheres.pairs)
    }
    contacts = 0
    for row, configuration in enumerate(joints):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for geom in data.contact.geom:
            names = frozenset(model.body(model.geom_bodyid[each]).name for each in geom)
            assert distance[row, pairs[names]] < 0.0  # no other pairs are in contact
            contacts += 1
    assert contacts > 0
