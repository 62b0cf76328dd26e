"""Obstacles: shapes, packed arrays, signed distances and clearance."""
