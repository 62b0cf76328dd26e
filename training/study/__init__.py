"""Studies: many trainings, baselines and searches for hyperparameters from one file."""
