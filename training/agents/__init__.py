"""Learning algorithms, their networks and replay buffers."""

from viapoint.training.agents.viaq import ViaQ  # which adds itself to the table of algorithms

__all__ = ["ViaQ"]
