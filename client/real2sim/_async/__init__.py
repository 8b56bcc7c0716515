"""The async client; ``scripts/unasync.py`` makes the sync client in ``_sync`` from it."""
