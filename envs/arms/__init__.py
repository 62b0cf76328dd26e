"""The arms: one record each."""
