"""Gymnasium environments whose actions are via-points and durations."""
