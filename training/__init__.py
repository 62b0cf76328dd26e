"""Learning to place via-points, and measuring how well it was learnt."""
