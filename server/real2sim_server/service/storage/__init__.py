"""Persistent storage of a worker: tables, rows, schema migrations."""
