"""The measurements behind docs/results.md: what is trained, the work, the numbers, the page, the figures."""
