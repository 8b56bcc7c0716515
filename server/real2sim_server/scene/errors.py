"""Errors of scenes and of files, and what readers leave out because of them.

SceneError
├── TimeOutOfRangeError   a pose was requested outside a trajectory
├── UnknownObjectError    an object id missing from the scene
├── LidarError            a LiDAR out of range, or a name missing from the catalogue
├── RadarError            a name missing from the catalogue of radars
└── BundleError           a file that is not a readable scene or splat file
    └── BundleTooLargeError   one that would exceed the memory limit

FileError                 base of LogError and MapError: a file of a log or a map cannot be read
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass


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


class FileError(ValueError):
    """A file of others cannot be read; the message names the place, the problem and the remedy."""


class LeftOut(defaultdict[str, list[str]]):
    """What a reader leaves out, or reads otherwise than it is written: names or sentences by kind.

    For example ``left_out["boxes"].append("labels.txt line 3: ...")``.
    """

    def __init__(self) -> None:
        super().__init__(list)

    def damaged(self, kind: str, name: str | None = None) -> _LeavingOut:
        """Leave out the part that the block reads if it is damaged, and tell its name and why.

        Without a name, only errors whose message names the place count as damage.
        """
        return _LeavingOut(self, kind, name)

    def told(self) -> dict[str, tuple[str, ...]]:
        """The names and sentences, without kinds that have none."""
        return {kind: tuple(given) for kind, given in self.items() if given}


_NAMED = (FileError, SceneError)
_DAMAGE = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, SceneError)


@dataclass(frozen=True)
class _LeavingOut:
    left_out: LeftOut
    kind: str
    name: str | None

    def __enter__(self) -> None:
        """Begin to read the part."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> bool:
        """Whether the part is left out."""
        if not isinstance(error, _NAMED if self.name is None else _DAMAGE):
            return False
        reason = str(error)
        if not isinstance(error, _NAMED):
            lacks = isinstance(error, KeyError)
            reason = f"lacks {error}" if lacks else f"{type(error).__name__}, {error}"
        self.left_out[self.kind].append(reason if self.name is None else f"{self.name}: {reason}")
        return True
