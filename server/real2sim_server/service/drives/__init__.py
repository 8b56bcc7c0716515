"""Planners that drive sessions as jobs, and what they leave."""
