"""Errors of scenes.

SceneError
├── TimeOutOfRangeError   a pose was requested outside a trajectory
├── UnknownObjectError    an object id missing from the scene
├── LidarError            a LiDAR out of range, or a name missing from the catalogue
├── RadarError            a name missing from the catalogue of radars
└── BundleError           a file that is not a readable scene or splat file
    └── BundleTooLargeError   one that would exceed the memory limit
"""

from __future__ import annotations


class SceneError(Exception):
    """A scene is invalid. The message gives the reason and the remedy."""


class TimeOutOfRangeError(SceneError, ValueError):
    """A pose was requested outside a trajectory's time range; trajectories do not extrapolate."""


class UnknownObjectError(SceneError, KeyError):
    """The object id is missing from the scene."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class LidarError(SceneError, ValueError):
    """A LiDAR is out of range or unknown; the message gives the value and the allowed ones."""


class RadarError(SceneError, ValueError):
    """The radar is not in the catalogue; the message lists the known ones."""


class BundleError(SceneError, ValueError):
    """A file or folder cannot be read as a scene; the message gives the location and the reason."""


class BundleTooLargeError(BundleError):
    """The content of a file exceeds the memory limit."""
