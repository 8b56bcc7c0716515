"""What each command of the worker does, one module a command."""
