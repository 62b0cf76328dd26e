"""Evaluation of methods and its statistics."""
