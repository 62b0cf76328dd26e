"""Copies of arms: one MJCF file that holds all that was chosen when an arm was loaded."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from viapoint.envs.arms.arm import Arm, arm_from_xml
from viapoint.envs.arms.spheres import LeftOut

MARK = "viapoint_arm"
"""Name of the text element with the choices."""
COPY = "arm.xml"
"""Name of a copy in the folder of a run or a model."""


def keep_arm(folder: Path, arm: Arm) -> None:
    """Write a copy of an arm that was loaded from a file into a folder; arms that are known by name need none."""
    if arm.file:
        write_arm(folder / COPY, arm)


def with_kept_arm(env_kwargs: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return arguments of an environment with the copy in a folder in place of an arm file that is gone."""
    found = dict(env_kwargs)
    file, copy = found.get("arm"), folder / COPY
    if isinstance(file, str) and Path(file).suffix and not Path(file).is_file() and copy.is_file():
        found["arm"] = str(copy.resolve())
    return found


def write_arm(path: Path, arm: Arm) -> None:
    """Write an arm as a self-contained MJCF file, from which :func:`read_arm` makes the same arm.

    Its geoms are the capsules that collide; visual meshes are left out.
    """
    choices = {
        "name": arm.name,
        "joints": arm.joint_names,
        "home": arm.home.tolist(),
        "velocity_limit": arm.velocity_limit.tolist(),
        "torque_limit": arm.torque_limit.tolist(),
        "space": arm.space,
        "left_out": arm.left_out,
        "excess": arm.excess,
        "continuous": arm.continuous,
        "notes": arm.notes,
    }
    root = ET.fromstring(arm.xml)
    custom = ET.SubElement(root, "custom")
    ET.SubElement(custom, "text", name=MARK, data=json.dumps(choices))
    path.write_text(ET.tostring(root, encoding="unicode"), encoding="utf-8")


def read_arm(path: Path) -> Arm | None:
    """Return the arm of a file of :func:`write_arm`; None for all other files."""
    text = path.read_text(encoding="utf-8", errors="replace")
    if MARK not in text:
        return None
    mark = ET.fromstring(text).find(f"custom/text[@name='{MARK}']")
    if mark is None:
        return None
    choices: dict[str, Any] = json.loads(mark.attrib["data"])
    left_out = tuple(LeftOut(*each) for each in choices["left_out"])
    arm = arm_from_xml(
        choices["name"],
        text,
        joints=choices["joints"],
        tool="hand",
        home=choices["home"],
        velocity_limit=choices["velocity_limit"],
        torque_limit=choices["torque_limit"],
        space=choices["space"],
        exclude={frozenset((pair.first, pair.second)): pair.reason for pair in left_out},
    )
    return replace(
        arm,
        left_out=left_out,
        excess=choices["excess"],
        continuous=tuple(choices["continuous"]),
        notes=tuple(choices["notes"]),
    )
