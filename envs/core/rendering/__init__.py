"""Rendering of movements and episodes."""
