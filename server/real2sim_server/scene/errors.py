"""Errors of the scene room.

SceneError
├── TimeOutOfRangeError   a pose was asked for outside a trajectory
├── UnknownObjectError    an object id the scene does not have
├── LidarError            a LiDAR that cannot be, or a name that the catalogue does not have
├── RadarError            a name that the catalogue of radars does not have
└── BundleError           a file that is not a readable scene or splat file
    └── BundleTooLargeError   one that would take more memory than it may
"""

from __future__ import annotations


class SceneError(Exception):
    """Something about a scene is not as it must be. The message says what, and what to do."""


class TimeOutOfRangeError(SceneError, ValueError):
    """A pose was asked for outside a trajectory's time range; trajectories never extrapolate."""


class UnknownObjectError(SceneError, KeyError):
    """An object id that the scene does not have."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class LidarError(SceneError, ValueError):
    """A LiDAR out of range or unknown; the message says what was given and what is allowed."""


class RadarError(SceneError, ValueError):
    """A radar that the catalogue does not have; the message names those it has."""


class BundleError(SceneError, ValueError):
    """A file or folder that cannot be read as a scene, with the place and the reason."""


class BundleTooLargeError(BundleError):
    """A file that would take more memory than it may, however small it is itself."""
