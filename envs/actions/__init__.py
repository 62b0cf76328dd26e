"""Decoding of actions into plans and references."""
