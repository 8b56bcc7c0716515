"""Search for avoidable failures of a planner.

In such a collision the planner is at fault, and a driver with knowledge of the future could have
avoided it.
"""
