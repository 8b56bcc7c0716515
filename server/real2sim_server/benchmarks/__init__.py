"""Measurements, each a ratio to a reference or a peer of the same run."""
