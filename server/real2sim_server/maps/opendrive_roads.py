"""Roads of an OpenDRIVE file with the lanes of their sections, with the file's lane numbers."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.special import fresnel

from real2sim_proto.lanes import LaneKind

from ..geometry import Float
from .reader import MapError, integer, number

# --- Plan view -----------------------------------------------------------------------------------

# Source: ASAM OpenDRIVE 1.8.1, chapter 9. Cubic curves are parametrised by arc length, like s.

MAX_LENGTH_M = 1e6
STRAIGHT = 1e-12
MIN_BEND = 1e-9
"""A spiral with a smaller change of curvature times length squared is an arc."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)

Local = Callable[[Float], Float]
"""Maps distances [K] along a piece to x, y and heading [K, 3] in the frame of its start."""


@dataclass(frozen=True)
class Piece:
    """One <geometry>.

    Attributes:
        s: start position on the road [m].
        length: length of the piece [m].
        x, y, heading: pose of its start.
        local: its shape.
        bends: whether it is not a straight line.
    """

    s: float
    length: float
    x: float
    y: float
    heading: float
    local: Local
    bends: bool


@dataclass(frozen=True)
class PlanView:
    """The reference line of a road, closed form."""

    pieces: tuple[Piece, ...]

    @property
    def length(self) -> float:
        """Total length of the pieces [m]."""
        last = self.pieces[-1]
        return last.s + last.length

    def at(self, s: Float) -> Float:
        """x, y [m] and heading [rad], [K, 3], at positions ``s`` [K] (clamped to the line)."""
        starts = np.array([piece.s for piece in self.pieces])
        index = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(starts) - 1)
        found = np.empty((len(s), 3))
        for k in np.unique(index).tolist():
            piece, mine = self.pieces[k], index == k
            u, v, turn = piece.local(np.clip(s[mine] - piece.s, 0.0, piece.length)).T
            cos, sin = math.cos(piece.heading), math.sin(piece.heading)
            found[mine, 0] = piece.x + cos * u - sin * v
            found[mine, 1] = piece.y + sin * u + cos * v
            found[mine, 2] = piece.heading + turn
        return found


def read_plan_view(road: ET.Element, where: str) -> PlanView:
    """The reference line of a <road>.

    Raises:
        MapError: the geometry is missing, of an unknown kind, or out of order.
    """
    pieces: list[Piece] = []
    for element in road.findall("planView/geometry"):
        s, x, y, heading = (number(element, n, where) for n in ("s", "x", "y", "hdg"))
        length = number(element, "length", where)
        if not 0 <= length <= MAX_LENGTH_M:
            raise MapError(f"{where}: geometry of length {length} m at s = {s}")
        if length < 1e-9:
            continue
        if pieces and s < pieces[-1].s:
            raise MapError(f"{where}: geometry at s = {s} follows one at s = {pieces[-1].s}")
        local, bends = _shape(element, length, f"{where}, geometry at s = {s}")
        pieces.append(Piece(s, length, x, y, heading, local, bends))
    if not pieces:
        raise MapError(f"{where}: has no <planView> with a <geometry> that has a length")
    return PlanView(tuple(pieces))


def _shape(element: ET.Element, length: float, where: str) -> tuple[Local, bool]:
    kinds: dict[str, Callable[[ET.Element], Local]] = {
        "line": lambda e: line(),
        "arc": lambda e: arc(number(e, "curvature", where)),
        "spiral": lambda e: spiral(
            number(e, "curvStart", where), number(e, "curvEnd", where), length
        ),
        "poly3": lambda e: _poly3(e, length, where),
        "paramPoly3": lambda e: _param_poly3(e, length, where),
    }
    for child in element:
        if child.tag in kinds:
            return kinds[child.tag](child), child.tag != "line"
    given = ", ".join(child.tag for child in element) or "nothing"
    raise MapError(f"{where}: holds {given}; known shapes are {', '.join(kinds)}")


def line() -> Local:
    """A straight line."""
    return lambda d: np.stack([d, np.zeros_like(d), np.zeros_like(d)], axis=1)


def arc(curvature: float) -> Local:
    """A circular arc with ``curvature`` [1/m], positive to the left."""
    if abs(curvature) < STRAIGHT:
        return line()

    def local(d: Float) -> Float:
        turn = curvature * d
        # Chord and half angle: exact for the flattest arcs as well.
        chord = d * np.sinc(turn / (2 * np.pi))
        return np.stack([chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn], axis=1)

    return local


def spiral(start: float, end: float, length: float) -> Local:
    """A clothoid with curvature linear from ``start`` to ``end`` [1/m].

    Its position is the integral of (cos, sin)(k d + c d^2 / 2): with the square completed, Fresnel
    integrals.
    """
    change = (end - start) / length
    if abs(change) * length**3 < MIN_BEND:
        return arc((start + end) / 2)
    scale = math.sqrt(math.pi / abs(change))
    sign = math.copysign(1.0, change)
    # Formula for an increasing curvature; a decreasing one is mirrored.
    k, c = sign * start, abs(change)
    rest = k * k / (2 * c)
    sin0, cos0 = fresnel(k / (c * scale))

    def local(d: Float) -> Float:
        sin1, cos1 = fresnel((d + k / c) / scale)
        p, q = scale * (cos1 - cos0), scale * (sin1 - sin0)
        cos, sin = math.cos(rest), math.sin(rest)
        x, y = cos * p + sin * q, cos * q - sin * p
        return np.stack([x, sign * y, start * d + change * d * d / 2], axis=1)

    return local


def cubic(u: tuple[float, ...], v: tuple[float, ...], end: float, length: float) -> Local:
    """The curve (u(p), v(p)) of two cubics for p from 0 to ``end``, by its arc length.

    ``length`` of the road is scaled to the whole curve, so that pieces meet as in the file.
    """
    grid = np.linspace(0.0, end, 257)
    du, dv = (np.polynomial.Polynomial(w).deriv() for w in (u, v))
    step = grid[1] - grid[0]
    p = grid[:-1, None] + step * (NODES + 1) / 2
    arcs = np.concatenate([[0.0], np.cumsum(np.hypot(du(p), dv(p)) @ WEIGHTS * step / 2)])
    total = arcs[-1]

    def local(d: Float) -> Float:
        wanted = d / length * total
        p = np.interp(wanted, arcs, grid)
        k = np.clip(np.searchsorted(arcs, wanted, side="right") - 1, 0, len(grid) - 2)
        for _ in range(3):  # Newton from within a 256th of the curve
            half = (p - grid[k]) / 2
            nodes = grid[k][:, None] + half[:, None] * (NODES + 1)
            passed = arcs[k] + np.hypot(du(nodes), dv(nodes)) @ WEIGHTS * half
            speed = np.maximum(np.hypot(du(p), dv(p)), 1e-12)
            p = np.clip(p + (wanted - passed) / speed, grid[k], grid[k + 1])
        pu, pv = (np.polynomial.Polynomial(w)(p) for w in (u, v))
        return np.stack([pu, pv, np.arctan2(dv(p), du(p))], axis=1)

    return local


def _poly3(element: ET.Element, length: float, where: str) -> Local:
    v = tuple(number(element, name, where) for name in "abcd")
    if max(abs(w) for w in v) > 1e6:
        raise MapError(f"{where}: poly3 with a coefficient above a million")
    slope = np.polynomial.Polynomial(v).deriv()
    # Find u where the arc length reaches the length of the piece; arc length is at least the chord.
    grid = np.linspace(0.0, length, 4097)
    middle = (grid[1:] + grid[:-1]) / 2
    passed = np.concatenate([[0.0], np.cumsum(np.hypot(1.0, slope(middle)) * np.diff(grid))])
    end = float(np.interp(length, passed, grid))
    return cubic((0.0, 1.0), v, end, length)


def _param_poly3(element: ET.Element, length: float, where: str) -> Local:
    u, v = (tuple(number(element, name + axis, where) for name in "abcd") for axis in ("U", "V"))
    if max(abs(w) for w in (*u, *v)) > 1e6:
        raise MapError(f"{where}: paramPoly3 with a coefficient above a million")
    ranges = {"arcLength": length, "normalized": 1.0}
    given = element.get("pRange", "normalized")
    if given not in ranges:
        raise MapError(f"{where}: pRange {given!r}; allowed: {', '.join(ranges)}")
    curve = cubic(u, v, ranges[given], length)
    if not np.isfinite(curve(np.array([0.0, length]))).all():
        raise MapError(f"{where}: paramPoly3 that is not a curve: all of its coefficients are zero")
    return curve


# --- Profiles ------------------------------------------------------------------------------------

# Cubic polynomials over s: elevation, superelevation, lane offset, widths.

SAME_START_M = 0.01
"""Records of a lane closer than this start at the same place."""
STEP_T_M = 0.01


@dataclass(frozen=True)
class Profile:
    """a + b d + c d^2 + d d^3 with d = s - start of the last record at or before s; 0 without one.

    Attributes:
        starts: [R] float64, increasing positions [m].
        rows: [R, 4] float64.
    """

    starts: Float
    rows: Float

    def at(self, s: Float, *, since: float = -np.inf, until: float = np.inf) -> Float:
        """Values [K] at positions ``s`` [K] of a section from ``since`` to ``until``. A record that
        starts within a centimetre of either applies from there on, so that a section keeps its own
        values up to its ends.
        """
        if not len(self.starts):
            return np.zeros_like(s)
        looked_up = np.minimum(np.maximum(s, since + SAME_START_M), until - SAME_START_M)
        k = np.searchsorted(self.starts, looked_up + 1e-12, side="right") - 1
        before = k < 0
        a, b, c, d = self.rows[np.maximum(k, 0)].T
        x = s - self.starts[np.maximum(k, 0)]
        return np.where(before, 0.0, a + x * (b + x * (c + x * d)))

    def steps(self) -> Iterator[float]:
        """Positions where the value jumps by more than a centimetre [m]."""
        before = np.zeros(4)
        for k, (start, row) in enumerate(zip(self.starts.tolist(), self.rows, strict=True)):
            passed = start - self.starts[k - 1] if k else 0.0
            if abs(np.polynomial.polynomial.polyval(passed, before) - row[0]) > STEP_T_M:
                yield start
            before = row


def read_profile(
    elements: Iterable[ET.Element],
    where: str,
    *,
    start: str = "s",
    base: float = 0.0,
    shortest: float = 0.0,
) -> Profile:
    """The profile of elements with attributes ``start``, a, b, c and d; ``base`` [m] is added to
    their starts. The record before one that lasts less than ``shortest`` [m] applies in its place.

    Raises:
        MapError: an attribute is missing or not a number.
    """
    rows = [[number(e, name, where) for name in (start, "a", "b", "c", "d")] for e in elements]
    table = np.array(sorted(rows, key=lambda row: row[0])).reshape(-1, 5)
    if len(table):
        table = table[np.append(np.diff(table[:, 0]) >= shortest, True)]
    return Profile(table[:, 0] + base, table[:, 1:])


STEP_M, BENT_STEP_M = 2.0, 0.5
JUMP_M = 1e-3
"""Length of a step of a border, and of the straight pieces before and after it."""
MAX_SAMPLES = 4_000_000
SAME_S = 1e-6

KINDS: dict[str, LaneKind] = {
    "bidirectional": "driving",
    "biking": "bicycle",
    "bus": "bus",
    "connectingramp": "driving",
    "driving": "driving",
    "entry": "driving",
    "exit": "driving",
    "hov": "driving",
    "mwyentry": "driving",
    "mwyexit": "driving",
    "offramp": "driving",
    "onramp": "driving",
    "parking": "parking",
    "shared": "driving",
    "shoulder": "shoulder",
    "sidewalk": "sidewalk",
    "slidelane": "driving",
    "sliplane": "driving",
    "stop": "shoulder",
    "taxi": "bus",
    "walking": "sidewalk",
}
"""Kinds by lower-case name in the file; other types are not part of the carriageway."""
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "": 1.0}
CHANGES = {"none": (False, False), "increase": (True, False), "decrease": (False, True)}
"""By the marking of a lane: whether it may be crossed towards higher and lower numbers."""


@dataclass(frozen=True)
class Link:
    """Continuation of a road: another road at one of its ends, or a junction."""

    kind: str
    element: str
    contact: str


@dataclass
class SectionLane:
    """One lane of one section.

    Attributes:
        number: negative to the right of the reference line.
        kind: kind of the lane.
        inner, outer: [M] t of its borders at the section's positions [m].
        links: numbers of connected lanes, by "predecessor" and "successor".
        speed_limit: [m/s] or None.
        may_increase, may_decrease: whether its outer mark may be crossed.
    """

    number: int
    kind: LaneKind
    inner: Float
    outer: Float
    links: dict[str, int]
    speed_limit: float | None
    may_increase: bool
    may_decrease: bool
    reversed: bool = False


@dataclass
class Section:
    """A lane section: positions along the road, and the lanes by number."""

    s: Float
    lanes: dict[int, SectionLane] = field(default_factory=dict)


@dataclass
class OpenDriveRoad:
    """A <road>.

    Attributes:
        road_id, junction: as in the file; ``junction`` None outside junctions.
        length: [m].
        plan: reference line seen from above.
        elevation, roll: along it.
        drives_right: rule of the road.
        links: by "predecessor" and "successor".
        sections: along s.
        element: XML element, for signals and objects.
        s: [N] sampled positions [m].
    """

    road_id: str
    junction: str | None
    length: float
    plan: PlanView
    elevation: Profile
    roll: Profile
    drives_right: bool
    links: dict[str, Link]
    sections: list[Section]
    element: ET.Element
    s: Float

    @property
    def where(self) -> str:
        """Name for messages."""
        return f"road {self.road_id!r}"


def read_road(element: ET.Element, file: str, left_out: Mapping[str, list[str]]) -> OpenDriveRoad:
    """A road of a file; ``left_out`` receives its name for a note on its length.

    Raises:
        MapError: names the file, the road and the problem.
    """
    road_id = element.get("id", "")
    where = f"{file}: road {road_id!r}"
    plan = read_plan_view(element, where)
    length = plan.length
    if not abs(number(element, "length", where, math.inf) - length) <= max(0.1, 1e-3 * length):
        left_out["roads with another length than their geometry, which is used"].append(road_id)
    junction = element.get("junction", "-1")
    road = OpenDriveRoad(
        road_id=road_id,
        junction=None if junction in ("-1", "") else junction,
        length=length,
        plan=plan,
        elevation=read_profile(element.findall("elevationProfile/elevation"), where),
        roll=read_profile(element.findall("lateralProfile/superelevation"), where),
        drives_right=element.get("rule", "RHT").upper() != "LHT",
        links=_links(element),
        sections=[],
        element=element,
        s=np.zeros(0),
    )
    starts = _section_starts(element, length, where)
    road.s = _sample_places(element, plan, length, [s for s, _ in starts], where)
    offset = _lateral(element.findall("lanes/laneOffset"), where)
    ends = [s for s, _ in starts[1:]] + [length]
    for (start, sides), end in zip(starts, ends, strict=True):
        s = road.s[(road.s >= start - SAME_S) & (road.s <= end + SAME_S)]
        middle = offset.at(s, since=start, until=end)
        stretch = _Stretch(road, start, end, s, middle, where)
        road.sections.append(_read_section(sides, stretch))
    _continue_sides(road.sections, [sides for _, sides in starts])
    return road


def _continue_sides(sections: list[Section], sides: list[Sides]) -> None:
    """Connect the lanes of a side with themselves where a section keeps it from the one before."""
    for (before, old), (after, new) in pairwise(zip(sections, sides, strict=True)):
        for n, lane in after.lanes.items():
            side = 1 if n > 0 else -1
            if new[side] == old.get(side):
                before.lanes[n].links["successor"] = lane.links["predecessor"] = n


def _links(element: ET.Element) -> dict[str, Link]:
    found = {}
    for end in ("predecessor", "successor"):
        link = element.find(f"link/{end}")
        if link is not None:
            found[end] = Link(
                link.get("elementType", "road"),
                link.get("elementId", ""),
                link.get("contactPoint", "start"),
            )
    return found


Sides = dict[int, tuple[ET.Element, float]]
"""<laneSection> that has the lanes of a side (-1: right, 1: left), and its start [m]."""


def _section_starts(element: ET.Element, length: float, where: str) -> list[tuple[float, Sides]]:
    """Start of each section, with its sides. A section with ``singleSide`` keeps the other side of
    the section before it.
    """
    sections = element.findall("lanes/laneSection")
    if not sections:
        raise MapError(f"{where}: has no <laneSection>")
    starts = sorted(((number(e, "s", where), i) for i, e in enumerate(sections)))
    found = [(s, sections[i]) for s, i in starts]
    if found[0][0] > 0.01:
        raise MapError(f"{where}: its first lane section starts at s = {found[0][0]}, not at 0")
    found[0] = (0.0, found[0][1])
    full: list[tuple[float, Sides]] = []
    for start, section in found:
        kept = section.get("singleSide") in ("true", "1") and full
        sides = dict(full[-1][1]) if kept else {}
        for lane in section.iter("lane"):
            if (n := integer(lane, "id", where)) != 0:
                sides[1 if n > 0 else -1] = (section, start)
        full.append((start, sides))
    ends = [s for s, _ in found[1:]] + [length]
    # Sections without length cannot be driven on; files have them at ends of roads.
    return [f for f, end in zip(full, ends, strict=True) if end - f[0] > SAME_S]


def _sample_places(
    element: ET.Element, plan: PlanView, length: float, sections: list[float], where: str
) -> Float:
    """Sampled positions of a road: every start of a record, and regular ones in between."""
    breaks = {0.0, length, *sections}
    for record in element.iter():
        if record.tag in ("elevation", "superelevation", "laneOffset", "geometry"):
            breaks.add(number(record, "s", where))
    steps = set(_lateral(element.findall("lanes/laneOffset"), where).steps())
    for section in element.findall("lanes/laneSection"):
        base = number(section, "s", where)
        for lane in section.iter("lane"):
            for tag in ("width", "border"):
                records = lane.findall(tag)
                breaks |= {base + number(r, "sOffset", where, 0.0) for r in records}
                steps |= set(_lateral(records, where, start="sOffset", base=base).steps())
    for s in steps:
        if min(abs(s - section) for section in (*sections, length)) > SAME_START_M:
            breaks |= {s - 2 * JUMP_M, s - JUMP_M, s, s + JUMP_M}
    wide = bool(element.findall("lanes/laneOffset")) or any(
        any(float(w.get(n, "0") or 0) != 0 for n in "bcd")
        for tag in ("width", "border")
        for w in element.iter(tag)
    )
    marks = np.array(sorted(s for s in breaks if 0 <= s <= length))
    marks = marks[np.concatenate([[True], np.diff(marks) > SAME_S])]
    marks[-1] = length
    starts = np.array([piece.s for piece in plan.pieces])
    places = []
    for a, b in pairwise(marks.tolist()):
        piece = plan.pieces[max(int(np.searchsorted(starts, a + SAME_S, side="right")) - 1, 0)]
        step = BENT_STEP_M if piece.bends else (1.0 if wide else STEP_M)
        places.append(np.linspace(a, b, max(int(np.ceil((b - a) / step)), 1), endpoint=False))
    found = np.concatenate([*places, [length]])
    if len(found) > MAX_SAMPLES:
        raise MapError(f"{where}: needs {len(found)} samples, above {MAX_SAMPLES}")
    return found


def _lateral(
    elements: list[ET.Element], where: str, *, start: str = "s", base: float = 0.0
) -> Profile:
    """The profile of a lane offset, width or border; a step between two records is one step."""
    return read_profile(elements, where, start=start, base=base, shortest=SAME_START_M)


@dataclass(frozen=True)
class _Stretch:
    """Geometry of a lane section: its road, the sampled positions, t of its centre line.

    ``base`` is the start of the <laneSection> with the lanes, from which their offsets count [m].
    """

    road: OpenDriveRoad
    start: float
    end: float
    s: Float
    middle: Float
    where: str
    base: float = 0.0

    def profile(self, elements: list[ET.Element]) -> Float:
        """Values [M] of records that begin at their ``sOffset``."""
        records = _lateral(elements, self.where, start="sOffset", base=self.base)
        return records.at(self.s, since=self.start, until=self.end)


def _read_section(sides: Sides, stretch: _Stretch) -> Section:
    section = Section(stretch.s)
    for side, (element, base) in sorted(sides.items()):
        at = replace(stretch, base=base)
        by_number: dict[int, ET.Element] = {}
        for lane in element.iter("lane"):
            index = integer(lane, "id", at.where)
            if index in by_number:
                raise MapError(f"{at.where}: lane {index} is there twice at s = {at.start}")
            by_number[index] = lane
        inner = at.middle
        for n in sorted((n for n in by_number if n * side > 0), key=abs):
            outer = _outer(by_number[n], inner, side, at)
            section.lanes[n] = _section_lane(by_number[n], n, (inner, outer), at)
            inner = outer
    return section


def _outer(lane: ET.Element, inner: Float, side: int, at: _Stretch) -> Float:
    """t of the outer border: the inner one plus a width, or a border, which takes precedence."""
    borders = lane.findall("border")
    if borders:
        return at.middle + at.profile(borders)
    width: Float = np.maximum(at.profile(lane.findall("width")), 0.0)
    return inner + side * width


def _section_lane(lane: ET.Element, n: int, rims: tuple[Float, Float], at: _Stretch) -> SectionLane:
    links = {}
    for link in ("predecessor", "successor"):
        found = lane.find(f"link/{link}")
        if found is not None:
            links[link] = integer(found, "id", at.where)
    mark = _road_mark(lane, at)
    change = "both"
    if mark is not None:
        solid = "solid" in mark.get("type", "") and mark.get("type") != "broken solid"
        change = mark.get("laneChange", "none" if solid else "both")
    increase, decrease = CHANGES.get(change, (True, True))
    return SectionLane(
        number=n,
        kind=KINDS.get(lane.get("type", "none").lower(), "other"),
        inner=rims[0],
        outer=rims[1],
        links=links,
        speed_limit=_speed_limit(lane, at),
        may_increase=increase,
        may_decrease=decrease,
        reversed=lane.get("direction", "standard") == "reversed",
    )


def _road_mark(lane: ET.Element, at: _Stretch) -> ET.Element | None:
    """The mark at the start of the section, otherwise the first one."""
    marks = lane.findall("roadMark")
    if at.base < at.start:
        passed = [
            m for m in marks if at.base + number(m, "sOffset", at.where, 0.0) <= at.start + SAME_S
        ]
        marks = passed[-1:] or marks
    return marks[0] if marks else None


def _speed_limit(lane: ET.Element, at: _Stretch) -> float | None:
    """Speed limit of the lane at the middle of its section, otherwise of the road there."""
    where, middle = at.where, (at.start + at.end) / 2
    own = [(at.base + number(e, "sOffset", where, 0.0), e) for e in lane.findall("speed")]
    types = [(number(e, "s", where), e) for e in at.road.element.findall("type")]
    of_road = [(s, speed) for s, e in types if (speed := e.find("speed")) is not None]
    for records in (own, of_road):
        before = [(s, e) for s, e in records if s <= middle]
        if before:
            return _speed(max(before, key=lambda record: record[0])[1], where)
    return None


def _speed(element: ET.Element, where: str) -> float | None:
    if element.get("max") in ("no limit", "undefined", None):
        return None
    unit = element.get("unit", "")
    if unit not in SPEED_UNITS:
        raise MapError(f"{where}: speed in {unit!r}; allowed: {', '.join(u for u in SPEED_UNITS)}")
    value = number(element, "max", where) * SPEED_UNITS[unit]
    return value if value > 0 else None
