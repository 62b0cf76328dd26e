"""Study behind docs/results.md: plan, jobs, aggregation, page and figures."""
