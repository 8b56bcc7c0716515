"""Scenarios of a worker: edits are serialized, and stored before they take effect."""
