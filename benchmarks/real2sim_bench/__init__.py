"""``real2sim bench``: measurements, each a ratio to a reference or a peer of the same run."""
