"""Files on disk and their limits."""
