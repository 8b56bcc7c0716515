"""The ego vehicle: plans, trackers and dynamics."""
