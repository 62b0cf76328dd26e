"""Learning algorithms, their networks and replay buffers."""
