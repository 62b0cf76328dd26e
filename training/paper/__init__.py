"""Flash & Hogan 1985 reproduced: every claim of the paper as a number, on the model and on the simulated arm."""
