"""Search for avoidable failures of a planner: it is at fault, and a driver who knows the future
could have avoided the collision.
"""
