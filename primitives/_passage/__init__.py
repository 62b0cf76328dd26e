"""Solvers for free passage times: closed forms for one via-point, Newton iterations for several."""
