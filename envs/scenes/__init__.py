"""Scenes: starts, goals and obstacles, and how they are drawn."""
