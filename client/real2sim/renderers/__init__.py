"""Renderer interfaces of other simulators, served by a worker.

Each adapter is a separate process between a simulator and a worker. It speaks the simulator's
protocol on one side and the SDK on the other. One worker can serve several adapters, and a failure
of an adapter affects no session.
"""
