"""Observations, rewards and task definitions."""
