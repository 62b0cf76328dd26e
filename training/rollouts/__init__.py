"""Rollouts of agents and methods in environments."""
