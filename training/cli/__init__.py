"""Command line of Viapoint."""
