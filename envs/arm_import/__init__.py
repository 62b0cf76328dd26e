"""Import of arms from MJCF files."""
