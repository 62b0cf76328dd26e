"""Colours of pictures, plots and films."""

from __future__ import annotations

Colour = tuple[float, float, float]  # Red, green and blue in [0, 1]


class Palette:
    """Colour of each kind of thing that is drawn."""

    plan: Colour = (0.36, 0.62, 0.90)
    executed: Colour = (0.07, 0.13, 0.27)
    via: Colour = (0.96, 0.56, 0.08)
    goal: Colour = (0.15, 0.64, 0.38)
    start: Colour = (0.42, 0.45, 0.50)
    obstacle: Colour = (0.80, 0.53, 0.41)
    contact: Colour = (0.86, 0.10, 0.14)
    arm: Colour = (0.63, 0.69, 0.77)
    joint: Colour = (0.30, 0.35, 0.44)
    table: Colour = (0.965, 0.96, 0.945)
    seen: Colour = (0.98, 0.80, 0.10)


PALETTE = Palette()
