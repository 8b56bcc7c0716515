"""REST routes and sockets, one module per subject."""
