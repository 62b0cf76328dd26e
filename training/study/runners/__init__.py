"""Runners of jobs on this machine and on Ray clusters; :mod:`viapoint.training.study.runner` describes them."""
