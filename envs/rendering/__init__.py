"""Rendering of movements."""
