"""Search for plans by computed geometry."""
