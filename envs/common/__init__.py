"""Helpers that all environment packages share."""
