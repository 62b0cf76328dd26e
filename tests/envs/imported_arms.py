"""Arm of docs/bring-your-arm.md, and variants of its file."""

from pathlib import Path

import numpy as np

from viapoint.envs.arm_import.loader import load_arm

UR5E = Path(__file__).parents[2] / "docs" / "ur5e.xml"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
HOME = (0.28, -1.55, -1.93, -1.232, np.pi / 2, 0.28)


def ur5e(**changes):
    return load_arm(**{"path": UR5E, "hand_site": "hand", "joints": JOINTS, "home": HOME, **changes})


def written(path, *changes):
    """Write the file with some words replaced to `path`; each word must be there."""
    text = UR5E.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)
    return path
