"""Training runs: folders, checkpoints and models."""
