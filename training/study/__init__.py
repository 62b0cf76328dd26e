"""Studies: many trainings and evaluations described by one YAML file, on one machine or many."""
