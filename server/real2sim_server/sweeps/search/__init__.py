"""A search for the avoidable failures of a planner: where it is at fault, and a driver who knows
what comes could have done otherwise."""
