"""Distances between arms and obstacles."""
