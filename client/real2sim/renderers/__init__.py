"""A worker's pictures behind the interfaces of other simulators.

Each is a process of its own between a simulator that drives and a worker that draws: it speaks the
simulator's protocol on one side and the SDK on the other. The worker knows nothing of it, one
worker serves several, and what fails in one touches no session.
"""
