"""Scenes and assets of a worker: on disk and in memory."""
