"""Distributions of scenes, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass

from viapoint.envs.actions.via_points import check_increasing_pair

MOST_OBSTACLES = 8
"""Obstacles of a scene at most."""


@dataclass(frozen=True, kw_only=True)
class SceneDistribution:
    """What scenes are like."""

    n_obstacles: tuple[int, int] = (1, 5)
    """Fewest and most obstacles."""
    distance: tuple[float, float] = (0.25, 0.45)
    """From start to goal, [m]."""
    post_radius: tuple[float, float] = (0.012, 0.045)
    """[m]."""
    bar_radius: tuple[float, float] = (0.006, 0.010)
    """[m]."""
    bar_half_length: tuple[float, float] = (0.05, 0.125)
    """[m]; the rows of lights of Flash & Hogan 1985 were up to 0.25 m long."""
    bar_tilt: float = 0.6
    """Greatest angle between a bar and the perpendicular of the straight line, [rad]."""
    spread: float = 0.26
    """Greatest distance of an obstacle's centre from the straight line, [m]."""
    ease: float = 0.3
    """Hardness is a uniform number to this power: less is harder."""
    ease_whole_arm: float = 0.02
    """The same where every link must clear."""
    witness_margin: float = 0.006
    """Least clearance of the witness, [m]: what sampling times and tracking may cost, and to spare."""
    link_margin: float = 0.003
    """Least clearance of the witness's links where they are looked at, [m]."""
    end_margin: float = 0.025
    """Least clearance of the hand at start and goal, [m]."""
    reach_margin: float = 0.03
    """How far inside the arm's reach start, goal and witness stay, [m]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be sampled."""
        fewest, most = self.n_obstacles
        if not 0 <= fewest <= most <= MOST_OBSTACLES:
            raise ValueError(
                f"n_obstacles must be (fewest, most), 0 <= fewest <= most <= {MOST_OBSTACLES}, got {self.n_obstacles}"
            )
        for name in ("distance", "post_radius", "bar_radius", "bar_half_length"):
            check_increasing_pair(name, getattr(self, name))


FAMILIES: dict[str, int] = {
    "clutter": 1,
    "pillar": 1,
    "shelf": 3,
    "gate": 3,
    "slot": 4,
    "window": 4,
    "tunnel": 6,
}
"""What may stand in the way, and the fewest obstacles that it takes.

`clutter` is a sphere, a post or a bar near the straight line, `pillar` a thick post on the table, `shelf` a board of
three bars side by side, `gate` two posts with a sill between them. `slot` is a shelf with a beam over the arm, `window`
a gate with one, `tunnel` two windows of one sill and one beam, one behind the other. Other spheres, posts and bars
stand about each.
"""
TRAINED = ("clutter", "pillar", "shelf", "gate", "slot", "window", "window")
"""Families that are drawn unless one says otherwise, the narrowest of them twice as often."""
NARROW = ("shelf", "gate", "slot", "window", "tunnel")
"""Families among whose scenes there are hard ones often enough to search for them."""
BOARDS = ("shelf", "slot")
"""Families that stand on a board of three bars, which the movement passes over."""
BEAMS = ("slot", "window", "tunnel")
"""Families with a beam, which the arm passes under."""


@dataclass(frozen=True, kw_only=True)
class SpaceDistribution:
    """What scenes of an arm that moves in space are like."""

    n_obstacles: tuple[int, int] = (1, 6)
    """Fewest and most obstacles; where a family takes more than the fewest, it gets them."""
    families: tuple[str, ...] = TRAINED
    """Drawn with equal chances, one named twice with twice the chance; those that take more than the most obstacles
    are left out."""
    distance: tuple[float, float] = (0.30, 0.50)
    """From start to goal, [m]."""
    steepness: float = 0.5
    """Greatest height gained on the way from start to goal, relative to the distance: arms come from above."""
    sphere_radius: tuple[float, float] = (0.02, 0.05)
    """[m]."""
    post_radius: tuple[float, float] = (0.012, 0.03)
    """[m]."""
    pillar_radius: tuple[float, float] = (0.025, 0.05)
    """[m]."""
    bar_radius: tuple[float, float] = (0.008, 0.015)
    """[m]."""
    bar_half_length: tuple[float, float] = (0.06, 0.18)
    """[m]."""
    board_half_length: tuple[float, float] = (0.10, 0.25)
    """Of a shelf's bars, [m]."""
    board_spacing: float = 0.04
    """Between a shelf's bars, [m]: nothing of the arm fits in between."""
    beam_half_length: tuple[float, float] = (0.08, 0.15)
    """[m]."""
    beam_overlap: float = 0.08
    """How far a beam reaches from above the hand towards the arm's base, [m]."""
    gate_half_width: tuple[float, float] = (0.06, 0.14)
    """Between the middle of a gate and each post, [m], before they make room; the gripper is 0.21 m wide."""
    tunnel_length: float = 0.1
    """Between its gates, [m]."""
    spread: float = 0.22
    """Greatest distance of other obstacles from the straight line, [m]."""
    ease: float = 0.15
    """Hardness is a uniform number to this power: less is harder."""
    link_margin: float = 0.006
    """Least clearance of the movement that is kept clear, its links included, at the times that are looked at, [m]."""
    end_margin: float = 0.02
    """Least clearance of the arm at start and goal, [m]."""
    reach_margin: float = 0.02
    """How far inside the arm's reach start, goal and the movement that is kept clear stay, [m]."""

    def __post_init__(self) -> None:
        """Refuse what cannot be sampled."""
        fewest, most = self.n_obstacles
        if not 0 <= fewest <= most <= MOST_OBSTACLES:
            raise ValueError(
                f"n_obstacles must be (fewest, most), 0 <= fewest <= most <= {MOST_OBSTACLES}, got {self.n_obstacles}"
            )
        unknown = sorted(set(self.families) - set(FAMILIES))
        if unknown or not self.families:
            raise ValueError(f"families must be some of {', '.join(FAMILIES)}, got {self.families!r}")
        if most and not self.possible:
            raise ValueError(f"families {self.families!r} take more than {most} obstacles")
        for name in (
            "distance", "sphere_radius", "post_radius", "pillar_radius", "bar_radius", "bar_half_length",
            "board_half_length", "beam_half_length", "gate_half_width",
        ):  # fmt: skip
            check_increasing_pair(name, getattr(self, name))

    @property
    def possible(self) -> tuple[str, ...]:
        """The families that take no more than the most obstacles."""
        return tuple(name for name in self.families if FAMILIES[name] <= self.n_obstacles[1])
