"""Plots, pictures and films of results."""
