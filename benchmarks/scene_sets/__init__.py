"""Generation of the frozen scenes."""
