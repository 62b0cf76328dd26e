"""Reproduction of Flash & Hogan 1985: every claim as a number, on the model and on the simulated arm."""
