"""Shared code of map readers: protocol, errors, JSON and XML files, lane borders."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..geometry import Float
from ..scene import Lane, LaneGraph


class MapReader(Protocol):
    """Reads one format of maps.

    Attributes:
        name: name of the format, for ``read_map(format=...)``.
        expects: one line for users with the required file or folder.
    """

    name: str
    expects: str

    def recognises(self, path: Path) -> bool:
        """Whether the file or folder has this format; cheap, and never raises."""
        ...

    def read(self, path: Path) -> LaneGraph:
        """The map at ``path``, in the map's own frame [m]: x and y seen from above, z up.

        Raises:
            MapError: names the file, the problem and the expected content.
        """
        ...


# --- Errors --------------------------------------------------------------------------------------


class MapError(ValueError):
    """A map that cannot be read or does not fit; the message names the file, the problem and the
    expected content.
    """


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Convert any error of the block to a MapError of a damaged map, unless it already is one.

    Raises:
        MapError: with ``where`` and the error.
    """
    try:
        yield
    except MapError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:300]}"
        raise MapError(f"{where}: is damaged, or not as its format asks ({reason})") from error


# --- JSON ----------------------------------------------------------------------------------------

MAX_BYTES = 512 << 20


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file.

    Raises:
        MapError: no such file, too large, not JSON, or not an object.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MapError(f"{path}: is larger than {MAX_BYTES >> 20} MiB, the most that is read")
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: is not a JSON file ({error})") from error
    if not isinstance(content, dict):
        raise MapError(f"{path}: holds no JSON object")
    return content


# --- XML -----------------------------------------------------------------------------------------

# Files are untrusted.


def read_xml(path: Path, root: str) -> ET.Element:
    """The root element of an XML file.

    Args:
        path: path of the file.
        root: expected name of the element.

    Raises:
        MapError: no such file, too large, not XML, with a document type, or another root.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise MapError(f"{path}: is larger than {MAX_BYTES >> 20} MiB, the most that is read")
        data = path.read_bytes()
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    # Entities could expand a small file until it fills the memory; maps do not need them.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise MapError(f"{path}: declares a document type or entities; maps have none")
    try:
        found = ET.fromstring(data)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise MapError(f"{path}: is not an XML file ({error})") from error
    if found.tag != root:
        raise MapError(f"{path}: its root is <{found.tag}>, expected <{root}>")
    return found


def head_of(path: Path, size: int = 4096) -> bytes:
    """First bytes of a file; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(size)
    except OSError:
        return b""


def number(element: ET.Element, name: str, where: str, default: float | None = None) -> float:
    """A finite attribute; ``default`` if it is missing.

    Raises:
        MapError: missing without a default, not a number, or not finite.
    """
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) < 1e12:
        given = "nothing" if text is None else repr(text[:80])
        raise MapError(f"{where}: {name} of <{element.tag}> must be a number, found {given}")
    return value


def integer(element: ET.Element, name: str, where: str) -> int:
    """An integer attribute. Raises MapError."""
    value = number(element, name, where)
    if value != int(value):
        raise MapError(f"{where}: {name} of <{element.tag}> must be whole, not {value}")
    return int(value)


# --- Lanes from borders --------------------------------------------------------------------------

STEP_M = 1.0
SAME_PLACE_M = 1e-3


def between(left: Float, right: Float) -> tuple[Float, Float] | None:
    """Centre line [N, 3] and widths [N] of the lane between two borders, about every metre; None if
    they have no length.

    Both borders are traversed in parallel, by their share of length, as in Lanelet2 and Argoverse.
    """
    if len(left) < 2 or len(right) < 2:
        return None
    # In some maps, the two borders of a lane have opposite directions.
    if np.linalg.norm(left[0] - right[0]) + np.linalg.norm(left[-1] - right[-1]) > np.linalg.norm(
        left[0] - right[-1]
    ) + np.linalg.norm(left[-1] - right[0]):
        right = right[::-1]
    rims = (left, right)
    lengths = [float(np.linalg.norm(np.diff(r[:, :2], axis=0), axis=1).sum()) for r in rims]
    if max(lengths) < SAME_PLACE_M:
        return None
    count = max(int(np.ceil(max(lengths) / STEP_M)), 1) + 1
    a, b = (_evenly(rim, count) for rim in (left, right))
    centre, widths = (a + b) / 2, np.linalg.norm((a - b)[:, :2], axis=1)
    kept = np.concatenate(
        [[True], np.linalg.norm(np.diff(centre[:, :2], axis=0), axis=1) > SAME_PLACE_M]
    )
    return (centre[kept], widths[kept]) if kept.sum() > 1 else None


def _evenly(line: Float, count: int) -> Float:
    steps = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, s[-1], count)
    found: Float = np.column_stack([np.interp(at, s, line[:, i]) for i in range(3)])
    return found


def joined(lanes: Iterable[Lane], **parts: Any) -> LaneGraph:
    """A graph of lanes without references to lanes outside a map section.

    Raises:
        SceneError: as :meth:`LaneGraph.of`.
    """
    there = {lane.lane_id: lane for lane in lanes}
    kept = [
        replace(
            lane,
            successors=tuple(n for n in lane.successors if n in there),
            left=lane.left if lane.left in there else None,
            right=lane.right if lane.right in there else None,
            opposite=lane.opposite if lane.opposite in there else None,
        )
        for lane in there.values()
    ]
    return LaneGraph.of(kept, **parts)
