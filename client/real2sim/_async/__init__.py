"""The async client; ``client/hatch_build.py`` makes the sync client in ``_sync`` from it."""
