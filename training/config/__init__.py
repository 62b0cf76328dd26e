"""Configuration of runs and commands."""
