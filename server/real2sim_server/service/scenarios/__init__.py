"""Scenarios of a worker: edited one at a time, on record before they take effect."""
