"""``real2sim bench``: benchmarks relative to a reference or another framework in the same run."""
