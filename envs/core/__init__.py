"""Core of version 2: arms as chains with spheres, compiled geometry, one environment."""
