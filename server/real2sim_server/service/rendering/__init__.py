"""The engine that owns the device, and pictures drawn on it."""
