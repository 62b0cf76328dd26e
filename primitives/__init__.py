"""Minimum-jerk movements through via-points: numbers in, trajectories out."""
