"""Training: from a first scene to one that looks like the log."""
