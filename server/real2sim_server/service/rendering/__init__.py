"""Rendering on the engine."""
