"""Choices for an arm of a file: tool, joints and limits, where the user names none."""

from __future__ import annotations

import itertools
import re
from typing import Any, NamedTuple

import mujoco
import numpy as np

from viapoint.envs.common.arrays import Float
from viapoint.envs.common.validation import finite_array

# Types of joints that an arm may have
MOVES = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
# Usual names of tools, the most telling first; prefixes that end in `_`, `/` or `:` may precede them
TOOL_NAMES = (
    r"attachment(_site)?", r"tcp", r"tool\d*(_?center)?(_?(point|frame|link))?", r"ee(f|_?site|_?link|_?frame)?",
    r"end_?effector.*", r"grip(per)?(_?(site|link|base|center))?", r"pinch(_?site)?", r"grasp(_?(site|target|frame))?",
    r"(right_|left_)?hand(_?(site|link))?", r"flange.*", r"link_(tcp|eef)",
)  # fmt: skip
GRIPPERS = re.compile(r"grip|jaw|finger|fngr|claw|knuckle", re.IGNORECASE)
"""Words in the names of bodies and joints of a gripper, which is not part of a chain whose tool has no usual name."""
LEAST_CHAIN = 3  # Least number of joints of a branch that is an arm and not a finger
KNOWN_VELOCITIES: dict[str, tuple[float, ...]] = {
    "panda": (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61),
    "fr3": (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    "ur3e": (3.14, 3.14, 3.14, 6.28, 6.28, 6.28),
    "ur5e": (3.14,) * 6,
    "ur10e": (2.09, 2.09, 3.14, 3.14, 3.14, 3.14),
    "iiwa14": (1.48, 1.48, 1.75, 1.31, 2.27, 2.36, 2.36),
    "gen3": (1.39, 1.39, 1.39, 1.39, 1.22, 1.22, 1.22),
    "xarm7": (3.14,) * 7,
    "lite6": (3.14,) * 6,
    "sawyer": (1.74, 1.33, 1.96, 1.96, 3.49, 3.49, 4.55),
    "rizon4": (2.09, 2.09, 2.44, 2.44, 4.89, 4.89, 4.89),
    "piper": (3.14, 3.4, 3.14, 3.93, 3.93, 3.93),
    "z1": (3.14,) * 6,
    "tiago": (0.07, 2.7, 3.66, 4.58, 4.58, 1.95, 1.76, 1.76),
    "j2s7s300": (0.628, 0.628, 0.628, 0.628, 0.838, 0.838, 0.838),
}
"""Velocity limits of well-known arms by a word of their name, [rad/s] or [m/s]: data sheets of Franka Robotics (Panda,
FR3), Universal Robots (e-Series), KUKA (LBR iiwa 14 R820), Kinova (Gen3), UFACTORY (xArm 7, Lite 6), Rethink Robotics
(Sawyer), Flexiv (Rizon 4) and AgileX (PiPER); URDF files of Unitree (Z1), PAL Robotics (TIAGo) and Kinova (Jaco)."""
# Torque limits of well-known arms that MuJoCo models often lack, [N m]: data sheet of KUKA (LBR iiwa 14 R820)
KNOWN_TORQUES: dict[str, tuple[float, ...]] = {"iiwa14": (320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0)}


class Tool(NamedTuple):
    """Frame of the tool."""

    body: int  # Body that carries it
    position: Float  # Place in the frame of the body, shape (3,), [m]
    quaternion: Float  # Orientation in this frame, shape (4,)
    name: str  # Name of the site or the body, for the report


def choose_tool(model: mujoco.MjModel, given: Any, base: str | None) -> Tool:
    """Return the tool: the given site, body, or body and point; else one with a usual name; else the tip of the chain.

    Raises:
        ValueError: There is no such part, or there are several arms and neither `tool` nor `base` tells which.
    """
    if isinstance(given, str):
        return _named_tool(model, given)
    if given is not None:
        try:
            name, point = given
        except (TypeError, ValueError):
            raise ValueError(
                f"tool must be a site, a body, or a pair of body and point, got {given!r:.60}"
            ) from None
        tool = _named_tool(model, name, "body")
        return tool._replace(position=finite_array("tool", point, (3,)), name=f"a point of {name!r}")
    names = [model.body(index).name for index in range(1, model.nbody)]
    if base is not None and base not in names:
        raise ValueError(
            f"there is no body {base!r} in the file; there are: {', '.join(filter(None, names))}"
        )
    root = 0 if base is None else int(model.body(base).id)
    chains: dict[int, list[str]] = {}
    for body in range(model.nbody):
        chain = chain_joints(model, body, base)
        if root in (body, *ancestors(model, body)) and len(chain) >= LEAST_CHAIN:
            chains[body] = chain
    matches: list[tuple[str, dict[int, str]]] = []
    kinds = (("site", model.nsite), ("body", model.nbody))
    for pattern, (kind, number) in itertools.product(TOOL_NAMES, kinds):
        found: dict[int, str] = {}
        for index in range(number):
            part = getattr(model, kind)(index)
            body = int(part.bodyid[0]) if kind == "site" else index
            # The name of the robot may be its prefix.
            fits = re.fullmatch(rf"(.*[_/:])?{pattern}", part.name, re.IGNORECASE)
            if fits and body in chains:
                found.setdefault(body, part.name)
        if found:
            matches.append((kind, found))
    if matches:
        kind, found = matches[0]
        # Of several on one chain, the last one counts.
        last = max(reversed(found), key=lambda body: len(chains[body]))
        rivals = [name for body, name in found.items() if not set(chains[body]) <= set(chains[last])]
        for _, others in matches[1:]:  # less telling names matter on other arms alone
            rivals += [name for body, name in others.items() if set(chains[body]).isdisjoint(chains[last])]
        if rivals:
            listed = ", ".join(dict.fromkeys([found[last], *rivals]))
            raise ValueError(f"there are several tools: {listed}; name one with tool=, or a side with base=")
        return _named_tool(model, found[last], kind)
    body = _tip(model, base)
    return Tool(body, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), f"the frame of {model.body(body).name!r}")


def _named_tool(model: mujoco.MjModel, name: str, kind: str = "") -> Tool:
    """Return the site of a name, or the origin of the body of a name."""
    sites = [model.site(index).name for index in range(model.nsite)]
    bodies = [model.body(index).name for index in range(1, model.nbody)]
    if name in sites and kind != "body":
        site = model.site(name)
        return Tool(int(site.bodyid[0]), site.pos.copy(), site.quat.copy(), name)
    if name in bodies:
        return Tool(int(model.body(name).id), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), name)
    raise ValueError(
        f"there is no site or body {name!r} in the file; sites are {', '.join(filter(None, sites)) or 'none'}; bodies "
        f"are {', '.join(filter(None, bodies)) or 'none'}"
    )


def chain_joints(model: mujoco.MjModel, body: int, base: str | None = None) -> list[str]:
    """Return the names of the hinges and slides that carry a body, from the base, whose own count, too, to it."""
    end = int(model.body(base).id) if base is not None else 0
    names: list[str] = []
    for each in (body, *ancestors(model, body)):
        first = int(model.body_jntadr[each])
        for joint in range(first, first + int(model.body_jntnum[each])):
            if model.jnt_type[joint] in MOVES:
                names.insert(0, model.joint(joint).name)
        if each == end:
            break
    return names


def arm_joints(model: mujoco.MjModel, chain: list[str], notes: list[str]) -> list[str]:
    """Return the joints of a chain without those of a mobile base, and without those of fingers.

    A body with a slide that has no end is a mobile base, unless a hinge carries it. Fingers are what hangs on a body
    from which several short branches move.
    """
    carriers = {name: int(model.joint(name).bodyid[0]) for name in chain}
    endless = (model.jnt_type == MOVES[1]) & (model.jnt_limited == 0)
    mobile = set()
    for name in chain:
        if endless[model.jnt_bodyid == carriers[name]].any():
            mobile.add(name)
        elif model.joint(name).type[0] == MOVES[0]:
            break
    below = {body: _joints_below(model, body) for body in range(model.nbody)}
    hands = set()
    for body in range(1, model.nbody):
        moving = [each for each in _children(model, body) if below[each]]
        if len(moving) > 1 and not any(_is_branch(model, each, below) for each in moving):
            hands.add(body)
    fingers = {name for name in chain if hands & set(ancestors(model, carriers[name]))}
    for some, what in ((mobile, "which seem to move a mobile base"), (fingers, "which seem to move fingers")):
        if some:
            notes.append(f"fixed: {', '.join(sorted(some))}, {what}")
    return [name for name in chain if name not in mobile | fingers]


def _children(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the bodies that hang on a body."""
    return [each for each in range(1, model.nbody) if model.body_parentid[each] == body]


def ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the bodies that carry a body, the nearest first."""
    found = []
    while body:
        body = int(model.body_parentid[body])
        found.append(body)
    return found


def _tip(model: mujoco.MjModel, base: str | None) -> int:
    """Return the last body of the longest chain of joints, or its flange, before it branches into fingers.

    Raises:
        ValueError: There are several arms, or no chain.
    """
    below = {body: _joints_below(model, body) for body in range(model.nbody)}
    body = int(model.body(base).id) if base is not None else 0
    while True:
        moving = [each for each in _children(model, body) if below[each]]
        arms = [each for each in moving if _is_branch(model, each, below)]
        if (
            len(arms) > 1
            and max(below[each] for each in arms) - min(below[each] for each in arms) < LEAST_CHAIN
        ):
            names = ", ".join(model.body(each).name or str(each) for each in arms)
            raise ValueError(f"the chain branches into {names}; name one with base=, or a tool with tool=")
        if arms:
            body = max(arms, key=lambda each: below[each])
        elif len(moving) == 1 and not _is_gripper(model, moving[0]):
            body = moving[0]
        else:  # nothing more that moves, or fingers
            break
    while not moving:  # the only frame without geoms on the last link is its flange
        frames = [each for each in _children(model, body) if not model.body_geomnum[each]]
        if len(frames) != 1:
            break
        body = frames[0]
    if len(chain_joints(model, body, base)) < 2:
        raise ValueError("no chain of two or more hinges and slides leads to a tool; name one with tool=")
    return body


def _is_branch(model: mujoco.MjModel, body: int, below: dict[int, int]) -> bool:
    """Return True if a body is the first of an arm, and not of a finger."""
    return below[body] >= LEAST_CHAIN and not _is_gripper(model, body)


def _is_gripper(model: mujoco.MjModel, body: int) -> bool:
    """Return True if a joint of a body is named after a part of a gripper; or the body, where nothing moves on it."""
    first = int(model.body_jntadr[body])
    number = int(model.body_jntnum[body])
    names = [model.joint(joint).name for joint in range(first, first + number)]
    if names and _joints_below(model, body) == number:
        names.append(model.body(body).name)
    return any(GRIPPERS.search(name) for name in names)


def _joints_below(model: mujoco.MjModel, body: int) -> int:
    """Return the greatest number of hinges and slides on a way from a body to a leaf, its own included."""
    first = int(model.body_jntadr[body])
    number = int(model.body_jntnum[body])
    own = sum(model.jnt_type[joint] in MOVES for joint in range(first, first + number))
    return own + max((_joints_below(model, each) for each in _children(model, body)), default=0)


def known_limits(table: dict[str, tuple[float, ...]], name: str, number: int) -> Float | None:
    """Return the limits of a well-known arm by whole words of its name, shape (J,); None for others."""
    for known, limits in table.items():
        # Between letters and digits there may be something else, as in `iiwa_14`.
        word = r"[\W_]*".join(re.findall(r"[a-z]+|[0-9]+", known))
        # A version may follow, as in `fr3v2`, `rizon4s` and `panda1`.
        version = r"([a-z]\d*)?" if known[-1].isdigit() else r"\d*"
        whole = re.search(rf"(?<![a-z0-9]){word}{version}(?![a-z0-9])", name.lower())
        if whole and len(limits) == number:
            return np.array(limits)
    return None
