"""Planners and baselines without learning."""
