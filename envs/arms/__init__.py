"""Arms: chains of joints with spheres on their links."""
