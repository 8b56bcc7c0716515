"""REST routes and sockets, one module a subject."""
