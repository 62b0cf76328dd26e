"""Physics simulation of plans and its metrics."""
