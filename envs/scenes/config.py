"""Distributions of scenes, in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from viapoint.envs.common.validation import check_increasing_pair, fewest_and_most
from viapoint.envs.geometry.rows import CAPSULES, check_shapes
from viapoint.envs.scenes.families import MOST_DRAWN, MOST_OBSTACLES, scene_families
from viapoint.envs.scenes.spatial_families import SpatialSizes

TRAINED = ("clutter", "pillar", "shelf", "gate", "slot", "window", "window")
"""Default families in space; the narrowest is drawn twice as often."""


@dataclass(frozen=True, kw_only=True)
class SceneDistribution:
    """Distribution of scenes in the plane."""

    dimension: ClassVar[int] = 2
    steepness: ClassVar[float] = 0.0

    n_obstacles: tuple[int, int] = (1, 5)
    """Fewest and most obstacles."""
    shapes: tuple[str, ...] = CAPSULES
    """Names of the shapes that obstacles may have; spheres are capsules without a length."""
    distance: tuple[float, float] = (0.25, 0.45)
    """Distance from start to goal, [m]."""
    post_radius: tuple[float, float] = (0.012, 0.045)
    """[m]"""
    bar_radius: tuple[float, float] = (0.006, 0.010)
    """[m]"""
    bar_half_length: tuple[float, float] = (0.05, 0.125)
    """[m]; the rows of lights of Flash & Hogan 1985 were up to 0.25 m long."""
    bar_tilt: float = 0.6
    """Greatest angle between a bar and the perpendicular of the straight line, [rad]."""
    spread: float = 0.26
    """Greatest distance of an obstacle's centre from the straight line, [m]."""
    hardness_exponent: float = 0.3
    """Hardness is a uniform number raised to this power: lower is harder."""
    hardness_exponent_whole_arm: float = 0.02
    """Hardness exponent of scenes in which every link must clear."""
    path_margin: float = 0.006
    """Least clearance of the hand on the feasible path, [m]; sampled times and tracking may cost a part of it."""
    link_margin: float = 0.003
    """Least clearance of the links on the feasible path, at the times at which it is computed, [m]."""
    end_margin: float = 0.025
    """Least clearance of the hand at start and goal, [m]."""
    reach_margin: float = 0.03
    """Least distance of start, goal and feasible path from the border of the reach, [m]."""

    @classmethod
    def for_shapes(cls, shapes: tuple[str, ...]) -> dict[str, Any]:
        """Return the arguments of a distribution with obstacles of some shapes."""
        return {"shapes": shapes}

    def __post_init__(self) -> None:
        """Check the ranges."""
        number = fewest_and_most("n_obstacles", self.n_obstacles, MOST_OBSTACLES, MOST_DRAWN)
        object.__setattr__(self, "n_obstacles", number)
        check_shapes(self.shapes, self.dimension)
        for name in ("distance", "post_radius", "bar_radius", "bar_half_length"):
            check_increasing_pair(name, getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class SpaceDistribution(SpatialSizes):
    """Distribution of scenes of an arm that moves in space."""

    dimension: ClassVar[int] = 3

    n_obstacles: tuple[int, int] = (1, 6)
    """Fewest and most obstacles; a scene has at least as many as its family needs."""
    shapes: tuple[str, ...] = CAPSULES
    """Names of the shapes that obstacles may have; spheres are capsules without a length."""
    families: tuple[str, ...] = TRAINED
    """Names of families, drawn with equal chances; a repeated name is drawn more often. Families that need more than
    the greatest number of obstacles are left out."""
    distance: tuple[float, float] = (0.30, 0.50)
    """Distance from start to goal, [m]."""
    steepness: float = 0.5
    """Greatest height gained from start to goal, relative to the distance: arms come from above."""
    spread: float = 0.22
    """Greatest distance of other obstacles from the straight line, [m]."""
    hardness_exponent: float = 0.15
    """Hardness is a uniform number raised to this power: lower is harder."""
    end_margin: float = 0.02
    """Least clearance of the arm at start and goal, [m]."""
    reach_margin: float = 0.02
    """Least distance of start, goal and feasible path from the border of the reach, [m]."""

    def __post_init__(self) -> None:
        """Check the ranges and the families."""
        number = fewest_and_most("n_obstacles", self.n_obstacles, MOST_OBSTACLES, MOST_DRAWN)
        object.__setattr__(self, "n_obstacles", number)
        check_shapes(self.shapes, self.dimension)
        unknown = sorted(set(self.families) - set(scene_families(3)))
        if unknown or not self.families:
            raise ValueError(
                f"families must be some of {', '.join(scene_families(3))}, got {self.families!r}"
            )
        if self.n_obstacles[1] and not self.possible:
            raise ValueError(
                f"families {self.families!r} take more than {self.n_obstacles[1]} obstacles, or others than "
                f"{self.shapes}"
            )
        for name in (
            "distance", "sphere_radius", "post_radius", "pillar_radius", "bar_radius", "bar_half_length",
            "board_half_length", "beam_half_length", "gate_half_width",
        ):  # fmt: skip
            check_increasing_pair(name, getattr(self, name))

    @property
    def possible(self) -> tuple[str, ...]:
        """Families that need no more than the greatest number of obstacles."""
        families = scene_families(3)
        return tuple(
            name
            for name in self.families
            if families[name].n_obstacles <= self.n_obstacles[1]
            and set(families[name].shapes) <= {*self.shapes, *CAPSULES}
        )

    @classmethod
    def for_shapes(cls, shapes: tuple[str, ...]) -> dict[str, Any]:
        """Return the arguments of a distribution with obstacles of some shapes: their families are drawn, too."""
        families = scene_families(3).items()
        others = tuple(
            name for name, family in families if family.trained and set(family.shapes) <= set(shapes)
        )
        return {"shapes": shapes, "families": TRAINED + others}
