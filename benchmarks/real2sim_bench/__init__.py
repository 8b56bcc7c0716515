"""``real2sim bench``: benchmarks, relative to a reference or a peer measured in the same run."""
