"""The sync client; all but ``concurrency`` is made from ``_async`` by ``scripts/unasync.py``."""
