"""The client's commands, one module each. Heavy imports are deferred until a command runs."""
