"""The worker on the network: engine, residency, store, REST routes and sockets.

The only room that knows HTTP.
"""
