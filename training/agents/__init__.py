"""Learning algorithms, their networks and replay buffers."""

from viapoint.training.agents.viaq import ViaQ  # which adds itself to the table of algorithms
from viapoint.training.agents.viarank import ViaRank

__all__ = ["ViaQ", "ViaRank"]
