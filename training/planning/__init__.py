"""Planning with known obstacles: candidates, compiled checks, and search."""
