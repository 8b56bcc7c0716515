"""Measurements of a worker as its users meet it. Stands above all rooms, the client included."""
