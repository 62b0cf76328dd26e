"""Free passage times of via-points."""
