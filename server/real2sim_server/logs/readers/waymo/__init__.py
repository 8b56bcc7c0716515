"""Waymo Open Dataset (perception), editions 1 and 2."""
