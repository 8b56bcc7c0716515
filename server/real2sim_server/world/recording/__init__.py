"""Episodes as files: recorded, replayed, exported."""
