"""What scenes are like."""

from __future__ import annotations

from dataclasses import dataclass

from viapoint.envs.action import check_increasing_pair

MOST = 8
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
        if not 0 <= fewest <= most <= MOST:
            raise ValueError(
                f"n_obstacles must be (fewest, most), 0 <= fewest <= most <= {MOST}, got {self.n_obstacles}"
            )
        for name in ("distance", "post_radius", "bar_radius", "bar_half_length"):
            check_increasing_pair(name, getattr(self, name))
