"""Frozen scene sets for validation and tests."""
