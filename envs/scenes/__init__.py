"""Scenes and their samplers."""
