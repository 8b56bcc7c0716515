"""Shared code of map readers: protocol, errors, JSON and XML files, lane borders."""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping, Sized
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from .._files import read_text, read_xml
from ..geometry import Float
from ..scene import Lane, LaneGraph
from ..scene.errors import FileError, LeftOut


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


class MapError(FileError):
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


# --- Parts that are left out ----------------------------------------------------------------------


def check_rest(
    file: str, what: str, rest: Sized, given: Sized, left_out: Mapping[str, list[str]]
) -> None:
    """Refuse a map of which nothing is left, or less than half.

    Raises:
        MapError: names the file and what was left out.
    """
    if len(rest) and 2 * len(rest) >= len(given):
        return
    if len(rest):
        lost = f"{len(given) - len(rest)} of its {len(given)} {what} cannot be read, more than half"
    else:
        lost = f"none of its {len(given)} {what} can be read"
    raise MapError(f"{file}: {lost} ({'; '.join(notes_of(left_out))})")


def notes_of(left_out: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Notes on names by kind: a sentence for each, with the number of names and the first five."""
    notes = []
    for kind, given in left_out.items():
        if not (names := list(dict.fromkeys(given))):
            continue
        first = ", ".join(name[:160] for name in names[:5])
        notes.append(f"{kind}: {len(names)} ({first}{', ...' if len(names) > 5 else ''})")
    return tuple(notes)


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
        content = json.loads(read_text(path))
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise MapError(f"{path}: is not a JSON file ({error})") from error
    if not isinstance(content, dict):
        raise MapError(f"{path}: holds no JSON object")
    return content


# --- XML -----------------------------------------------------------------------------------------


def read_map_xml(path: Path, root: str) -> ET.Element:
    """The root element of an XML file.

    Args:
        path: path of the file.
        root: expected name of the element.

    Raises:
        MapError: no such file, too large, not XML, with a document type, or another root.
    """
    try:
        found = read_xml(path)
    except OSError as error:
        raise MapError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise MapError(f"{path}: {error}") from error
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


def number(element: ET.Element, name: str, default: float | None = None) -> float:
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
        raise MapError(f"{name} of <{element.tag}> must be a number, found {given}")
    return value


def integer(element: ET.Element, name: str) -> int:
    """An integer attribute. Raises MapError."""
    value = number(element, name)
    if value != int(value):
        raise MapError(f"{name} of <{element.tag}> must be whole, not {value}")
    return int(value)


# --- Lanes from borders --------------------------------------------------------------------------

STEP_M = 1.0
SAME_PLACE_M = 1e-3
FIT_M = 0.03
"""Accepted distance between the borders of a lane and the given ones [m]."""
CORNER = math.radians(3.0)
"""Minimum turn of a centre line that is kept exactly [rad]."""
MAX_BORDER_M = 1e5
MAX_COMPARED = 2_000_000
"""Maximum number of pairs of a point and a segment that are compared for a lane: about a second."""


def between(left: Float, right: Float) -> tuple[Float, Float] | None:
    """Centre line [N, 3] and widths [N] of the lane between two borders, about every metre; None if
    they have no length.

    Both borders are traversed in parallel, by their share of length, as in Lanelet2 and Argoverse.
    If the borders of the result leave the given ones, as beside kinks, nearest points are paired,
    unless the lane is a kilometre long with points every metre.

    Raises:
        MapError: a border is longer than 100 km, or its points are not numbers.
    """
    if len(left) < 2 or len(right) < 2:
        return None
    # In some maps, the two borders of a lane have opposite directions.
    if np.linalg.norm(left[0] - right[0]) + np.linalg.norm(left[-1] - right[-1]) > np.linalg.norm(
        left[0] - right[-1]
    ) + np.linalg.norm(left[-1] - right[0]):
        right = right[::-1]
    lengths = [float(_along(rim)[-1]) for rim in (left, right)]
    if max(lengths) < SAME_PLACE_M:
        return None
    if not all(length < MAX_BORDER_M for length in lengths):
        raise MapError(f"its borders are {lengths[0]:g} and {lengths[1]:g} m long")
    count = max(int(np.ceil(max(lengths) / STEP_M)), 1) + 1
    a, b = (_at(r, np.linspace(0.0, s, count)) for r, s in zip((left, right), lengths, strict=True))
    centre, widths = (a + b) / 2, np.linalg.norm((a - b)[:, :2], axis=1)
    kept = _apart(centre)
    even = (centre[kept], widths[kept]) if kept.sum() > 1 else None
    if count * (len(left) + len(right)) > MAX_COMPARED:
        return even
    if (off := _misfit(even, left, right)) <= FIT_M:
        return even
    nearest = _paired(left, right)
    return nearest if _misfit(nearest, left, right) < off else even


def _along(line: Float) -> Float:
    """Arc length of the points of a line, seen from above [m]."""
    steps = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _at(line: Float, s: Float, known: Float | None = None) -> Float:
    """Points [K, D] of a line at arc lengths [K]."""
    known = _along(line) if known is None else known
    return np.column_stack([np.interp(s, known, column) for column in line.T])


def _apart(line: Float) -> Any:
    """Which points of a line differ from the one before."""
    steps = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    return np.concatenate([[True], steps > SAME_PLACE_M])


def _paired(left: Float, right: Float) -> tuple[Float, Float] | None:
    """Centre line and widths from pairs of nearest points of both borders.

    On both sides of a corner there is a point as far away as the foot of its inner border. So the
    corner has the mean of both directions, and the corners of both borders stay in place.
    """
    pairs = [np.zeros(2), np.array([_along(left)[-1], _along(right)[-1]])]
    for rim, other, order in ((left, right, 1), (right, left, -1)):
        known = _along(rim)
        grid = np.linspace(0.0, known[-1], int(np.ceil(known[-1] / STEP_M)) + 1)
        own = np.union1d(known, grid)
        pairs += list(np.column_stack([own, _nearest(_at(rim, own), other)[0]])[:, ::order])
    s_left, s_right = np.maximum.accumulate(sorted(pairs, key=sum), axis=0).T
    ladder = np.column_stack([_at(left, s_left), _at(right, s_right)])
    ladder = ladder[_apart(ladder[:, :3] + ladder[:, 3:])]
    centre = (ladder[:, :3] + ladder[:, 3:]) / 2
    s = _along(centre)
    turns = np.diff(np.unwrap(np.arctan2(*np.diff(centre[:, :2], axis=0).T[::-1])))
    k = np.flatnonzero(np.abs(turns) > CORNER) + 1
    corners = np.concatenate([[0.0], s[k], s[-1:]])
    half = np.linalg.norm(ladder[k, :2] - ladder[k, 3:5], axis=1) / 2
    feet = half * np.sin(np.minimum(np.abs(turns[k - 1]), np.pi / 2) / 2)
    gaps = np.diff(corners)
    feet = np.concatenate([[0.0], np.minimum(feet, np.minimum(gaps[1:], gaps[:-1])), [0.0]])
    places = [corners]
    for a, b in zip((corners + feet)[:-1], (corners - feet)[1:], strict=True):
        if a <= b:
            places.append(np.linspace(a, b, int((b - a) / STEP_M) + 2))
    ladder = _at(ladder, np.unique(np.concatenate(places)), s)
    ladder = ladder[_apart((ladder[:, :3] + ladder[:, 3:]) / 2)]
    if len(ladder) < 2:
        return None
    centre, rungs = (ladder[:, :3] + ladder[:, 3:]) / 2, ladder[:, :3] - ladder[:, 3:]
    heading = Lane("", "driving", centre, np.zeros(len(centre))).headings
    across = np.column_stack([-np.sin(heading), np.cos(heading)])
    return centre, np.abs((rungs[:, :2] * across).sum(axis=1))


def _nearest(points: Float, line: Float) -> tuple[Float, Float]:
    """Arc lengths [K] of the points of a line nearest to ``points`` [K, D], and distances [K]."""
    start, step = line[:-1], np.diff(line, axis=0)
    squares, known = np.maximum((step * step).sum(axis=1), 1e-12), _along(line)
    found = np.empty((2, len(points)))
    for first in range(0, len(points), 256):  # bounds the memory for long lines
        rest = points[first : first + 256, None] - start
        share = np.clip((rest * step).sum(axis=2) / squares, 0.0, 1.0)
        distances = np.linalg.norm(rest - share[..., None] * step, axis=2)
        k = distances.argmin(axis=1)[:, None]
        share, distances = (np.take_along_axis(a, k, 1)[:, 0] for a in (share, distances))
        k = k[:, 0]
        found[:, first : first + 256] = known[k] + share * (known[k + 1] - known[k]), distances
    return found[0], found[1]


def _misfit(shape: tuple[Float, Float] | None, left: Float, right: Float) -> float:
    """Largest distance between the borders of a shape and the given ones [m]. Lines go on straight
    beyond their ends, because lanes end at a right angle and given borders need not.
    """
    if shape is None:
        return math.inf
    off = 0.0
    for pair in zip(Lane("", "driving", *shape).rims, (left, right), strict=True):
        rim, given = (line[_apart(line), :2] for line in pair)
        if min(len(rim), len(given)) < 2:  # the borders meet in a point
            continue
        for points, line in ((rim, given), (given, rim)):
            ends = line[[0, -1]] + (line[[0, -1]] - line[[1, -2]]) * 1e3
            long = np.concatenate([ends[:1], line, ends[1:]])
            off = max(off, float(_nearest(points, long)[1].max()))
    return off


_IDS = {
    "areas": "area_id",
    "stop_lines": "stop_line_id",
    "signals": "signal_id",
}


def joined(lanes: Iterable[Lane], left_out: LeftOut | None = None, **parts: Any) -> LaneGraph:
    """A graph of lanes without references to lanes that are not there.

    Args:
        lanes: the first one of each id is kept.
        left_out: receives the links to other lanes, and becomes the notes of the graph.
        **parts: as for :meth:`LaneGraph.of`; the first part of each id is kept.

    Raises:
        SceneError: as :meth:`LaneGraph.of`.
    """
    told = LeftOut() if left_out is None else left_out
    there = unique(lanes, "lane_id", told["lanes left out because their id is there twice"])
    absent = told["links to lanes that are not in the file"]
    kept = []
    for lane in there.values():
        beside = {side: getattr(lane, side) for side in ("left", "right", "opposite")}
        named = (*lane.successors, *(name for name in beside.values() if name is not None))
        absent += [f"{lane.lane_id} to {name}" for name in named if name not in there]
        successors = tuple(name for name in lane.successors if name in there)
        beside = {side: name if name in there else None for side, name in beside.items()}
        kept.append(replace(lane, successors=successors, **beside))
    for name, key in _IDS.items():
        twice = told[f"{name.replace('_', ' ')} left out because their id is there twice"]
        parts[name] = unique(parts.get(name, ()), key, twice).values()
    if left_out is not None:
        parts["notes"] = notes_of(told)
    return LaneGraph.of(kept, **parts)


Part = TypeVar("Part")


def unique(parts: Iterable[Part], key: str, twice: list[str]) -> dict[str, Part]:
    """The first part of each id; ``twice`` receives the ids of the others."""
    found: dict[str, Part] = {}
    for part in parts:
        name = getattr(part, key)
        if name in found:
            twice.append(name)
        else:
            found[name] = part
    return found
