"""Durable memory of a worker: tables, rows, migrations of state."""
