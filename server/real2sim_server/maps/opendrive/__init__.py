"""OpenDRIVE: roads as reference lines with numbered lanes."""

from .reader import OpenDriveReader

__all__ = ["OpenDriveReader"]
