"""Sweeps and searches as jobs: `real2sim sweep` and `real2sim search` in processes of their own."""
