"""Claims of the paper, one module for each group."""
