"""The sync client; all but ``concurrency`` is made from ``_async`` by ``client/hatch_build.py``."""
