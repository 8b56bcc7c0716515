"""Roads of an OpenDRIVE file with the lanes of their sections, with the file's lane numbers."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy.special import fresnel

from real2sim_proto.lanes import LaneKind

from ..geometry import Float
from ..scene.errors import LeftOut
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


def read_plan_view(road: ET.Element) -> PlanView:
    """The reference line of a <road>.

    Raises:
        MapError: the geometry is missing, of an unknown kind, or out of order.
    """
    pieces: list[Piece] = []
    for element in road.findall("planView/geometry"):
        s, x, y, heading = (number(element, n) for n in ("s", "x", "y", "hdg"))
        length = number(element, "length")
        if not 0 <= length <= MAX_LENGTH_M:
            raise MapError(f"geometry of length {length} m at s = {s}")
        if length < 1e-9:
            continue
        if pieces and s < pieces[-1].s:
            raise MapError(f"geometry at s = {s} follows one at s = {pieces[-1].s}")
        local, bends = _shape(element, length, f"geometry at s = {s}")
        pieces.append(Piece(s, length, x, y, heading, local, bends))
    if not pieces:
        raise MapError("has no <planView> with a <geometry> that has a length")
    return PlanView(tuple(pieces))


def _shape(element: ET.Element, length: float, where: str) -> tuple[Local, bool]:
    kinds: dict[str, Callable[[ET.Element], Local]] = {
        "line": lambda e: line(),
        "arc": lambda e: arc(number(e, "curvature")),
        "spiral": lambda e: spiral(number(e, "curvStart"), number(e, "curvEnd"), length),
        "poly3": lambda e: _poly3(e, length, where),
        "paramPoly3": lambda e: _param_poly3(e, length, where),
    }
    for child in element:
        if child.tag in kinds:
            return kinds[child.tag](child), child.tag != "line"
    given = ", ".join(child.tag for child in element) or "nothing"
    raise MapError(f"{where} holds {given}; known shapes are {', '.join(kinds)}")


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
    v = tuple(number(element, name) for name in "abcd")
    if max(abs(w) for w in v) > 1e6:
        raise MapError(f"{where} has a poly3 with a coefficient above a million")
    slope = np.polynomial.Polynomial(v).deriv()
    # Find u where the arc length reaches the length of the piece; arc length is at least the chord.
    grid = np.linspace(0.0, length, 4097)
    middle = (grid[1:] + grid[:-1]) / 2
    passed = np.concatenate([[0.0], np.cumsum(np.hypot(1.0, slope(middle)) * np.diff(grid))])
    end = float(np.interp(length, passed, grid))
    return cubic((0.0, 1.0), v, end, length)


def _param_poly3(element: ET.Element, length: float, where: str) -> Local:
    u, v = (tuple(number(element, name + axis) for name in "abcd") for axis in ("U", "V"))
    if max(abs(w) for w in (*u, *v)) > 1e6:
        raise MapError(f"{where} has a paramPoly3 with a coefficient above a million")
    ranges = {"arcLength": length, "normalized": 1.0}
    given = element.get("pRange", "normalized")
    if given not in ranges:
        raise MapError(f"{where} has pRange {given!r}; allowed: {', '.join(ranges)}")
    curve = cubic(u, v, ranges[given], length)
    if not np.isfinite(curve(np.array([0.0, length]))).all():
        raise MapError(
            f"{where} has a paramPoly3 that is not a curve: all of its coefficients are zero"
        )
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
    rows = [[number(e, name) for name in (start, "a", "b", "c", "d")] for e in elements]
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
SPEED_UNITS = {
    "": 1.0, "m/s": 1.0, "mps": 1.0, "km/h": 1 / 3.6, "kmh": 1 / 3.6, "kph": 1 / 3.6,
    "mph": 0.44704,
}  # fmt: skip
"""By lower-case name [m/s]."""
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


SAME_LENGTH_M = 0.01


def read_road(element: ET.Element, left_out: LeftOut) -> OpenDriveRoad:
    """A road of a file; ``left_out`` receives its parts that are left out or read otherwise.

    Raises:
        MapError: the road has no lanes, or the course of its reference line is not known.
    """
    road_id = element.get("id", "")
    _leave_out_damage(element, road_id, left_out)
    plan = read_plan_view(element)
    length = plan.length
    if not abs(number(element, "length", math.inf) - length) <= SAME_LENGTH_M:
        left_out["roads with another length than their geometry, which is used"].append(road_id)
    if any(abs(b.s - a.s - a.length) > SAME_LENGTH_M for a, b in pairwise(plan.pieces)):
        left_out["roads with gaps or overlaps between their geometries"].append(road_id)
    junction = element.get("junction", "-1")
    rule = element.get("rule", "RHT").upper()
    if rule not in ("RHT", "LHT"):
        left_out["roads with an unknown traffic rule, read as RHT"].append(f"{road_id}: {rule}")
    road = OpenDriveRoad(
        road_id=road_id,
        junction=None if junction in ("-1", "") else junction,
        length=length,
        plan=plan,
        elevation=read_profile(element.findall("elevationProfile/elevation")),
        roll=read_profile(element.findall("lateralProfile/superelevation")),
        drives_right=rule != "LHT",
        links=_links(element, road_id, left_out),
        sections=[],
        element=element,
        s=np.zeros(0),
    )
    for what, profile in (("elevation", road.elevation), ("superelevation", road.roll)):
        if len(profile.starts) and profile.starts[0] > SAME_LENGTH_M:
            left_out[f"roads whose {what} begins later than they do, 0 before"].append(road_id)
    starts = _section_starts(element, length, road_id, left_out)
    road.s = _sample_places(element, plan, length, [s for s, _ in starts])
    offset = _lateral(element.findall("lanes/laneOffset"))
    ends = [s for s, _ in starts[1:]] + [length]
    for i, ((start, sides), end) in enumerate(zip(starts, ends, strict=True)):
        s = road.s[(road.s >= start - SAME_S) & (road.s <= end + SAME_S)]
        middle = offset.at(s, since=start, until=end)
        stretch = _Stretch(road, f"{road_id}.{i}", start, end, s, middle, left_out)
        road.sections.append(_read_section(sides, stretch))
    _continue_sides(road.sections, [sides for _, sides in starts])
    return road


def _leave_out_damage(element: ET.Element, road_id: str, left_out: LeftOut) -> None:
    """Take what cannot be read out of the lanes of a road, and its types.

    Without the width of a lane, the places of the lanes further out are not known either.

    Raises:
        MapError: the section is one of a single side, so that its other side would be taken for
            the missing one.
    """
    for kind in element.findall("type"):
        if _is_damaged(kind, "s", left_out, "types of roads that cannot be read", road_id):
            element.remove(kind)
    for i, section in enumerate(element.findall("lanes/laneSection")):
        damaged = _damaged_lanes(section, f"{road_id}.{i}", left_out)
        if damaged and section.get("singleSide") in ("true", "1"):
            n = damaged[0].get("id")
            raise MapError(f"lane {n!r} in a <laneSection> with singleSide cannot be read")
        for side in section:
            for lane in [lane for lane in side if lane in damaged]:
                side.remove(lane)


def _damaged_lanes(section: ET.Element, name: str, left_out: LeftOut) -> list[ET.Element]:
    """Lanes that cannot be read or placed, without their other damaged parts."""
    unread = "lanes left out because they cannot be read"
    damaged: list[ET.Element] = []
    placed: dict[int, ET.Element] = {}
    complete = True
    for lane in section.findall("*/lane"):
        number_known = False
        with left_out.damaged(unread, f"{name}.{lane.get('id', '')}"):
            n = integer(lane, "id")
            number_known = True
            if n in placed:
                raise MapError("its number is there twice")
            placed[n] = lane
            continue
        damaged.append(lane)
        complete = complete and number_known
    for side in (-1, 1):
        further_in, is_known = 0, True
        for n in sorted((n for n in placed if n * side > 0), key=abs):
            own, lane = f"{name}.{n}", placed[n]
            if n != further_in + side:
                left_out["lanes beside a gap in the lane numbers"].append(own)
                is_known = is_known and complete
            further_in = n
            if not is_known:
                kind = "lanes left out because a lane further in cannot be read"
                left_out[kind].append(own)
                damaged.append(lane)
                continue
            is_known = False
            with left_out.damaged(unread, own):
                for records in (lane.findall("width"), lane.findall("border")):
                    _lateral(records, start="sOffset")
                _leave_out_parts(lane, own, left_out)
                is_known = True
            if not is_known:
                damaged.append(lane)
    return damaged


def _leave_out_parts(lane: ET.Element, name: str, left_out: LeftOut) -> None:
    """Take links, marks and speeds that cannot be read out of a lane."""
    for path, attribute in (
        ("link/predecessor", "id"),
        ("link/successor", "id"),
        ("roadMark", "sOffset"),
        ("speed", "sOffset"),
    ):
        parent = lane.find("link") if path.startswith("link/") else lane
        for part in lane.findall(path):
            kind = "links, marks and speeds of lanes that cannot be read"
            if _is_damaged(part, attribute, left_out, kind, name) and parent is not None:
                parent.remove(part)


def _is_damaged(
    element: ET.Element, attribute: str, left_out: LeftOut, kind: str, name: str
) -> bool:
    with left_out.damaged(kind, name):
        if attribute == "id":
            integer(element, attribute)
        else:
            number(element, attribute, 0.0 if attribute == "sOffset" else None)
        return False
    return True


def _is_number(text: str) -> bool:
    try:
        return float(text).is_integer()
    except ValueError:
        return False


def _continue_sides(sections: list[Section], sides: list[Sides]) -> None:
    """Connect the lanes of a side with themselves where a section keeps it from the one before."""
    for (before, old), (after, new) in pairwise(zip(sections, sides, strict=True)):
        for n, lane in after.lanes.items():
            side = 1 if n > 0 else -1
            if new[side] == old.get(side):
                before.lanes[n].links["successor"] = lane.links["predecessor"] = n


def _links(element: ET.Element, road_id: str, left_out: LeftOut) -> dict[str, Link]:
    found = {}
    for end in ("predecessor", "successor"):
        link = element.find(f"link/{end}")
        if link is None:
            continue
        kind, contact = link.get("elementType", "road"), link.get("contactPoint")
        if contact is None and kind == "road" and link.get("elementS") is None:
            left_out["links of roads without a contact point, read as the start"].append(road_id)
        elif contact not in (None, "start", "end"):
            told = left_out["links of roads left out because of their contact point"]
            told.append(f"{road_id}: {contact!r}")
            continue
        found[end] = Link(kind, link.get("elementId", ""), contact or "start")
    return found


Sides = dict[int, tuple[ET.Element, float]]
"""<laneSection> that has the lanes of a side (-1: right, 1: left), and its start [m]."""


def _section_starts(
    element: ET.Element, length: float, road_id: str, left_out: LeftOut
) -> list[tuple[float, Sides]]:
    """Start of each section, with its sides. A section with ``singleSide`` keeps the other side of
    the section before it.
    """
    sections = element.findall("lanes/laneSection")
    if not sections:
        raise MapError("has no <laneSection>")
    starts = sorted(((number(e, "s"), i) for i, e in enumerate(sections)))
    beyond = [s for s, _ in starts if s > length + SAME_LENGTH_M]
    kind = "lane sections left out because they start after the end of their road"
    left_out[kind] += [f"{road_id}: s = {s:g}" for s in beyond]
    found = [(s, sections[i]) for s, i in starts if s not in beyond]
    if not found or abs(found[0][0]) > SAME_LENGTH_M:
        raise MapError(f"its first lane section starts at s = {starts[0][0]}, not at 0")
    found[0] = (0.0, found[0][1])
    full: list[tuple[float, Sides]] = []
    for start, section in found:
        kept = section.get("singleSide") in ("true", "1") and full
        sides = dict(full[-1][1]) if kept else {}
        for lane in section.findall("*/lane"):
            if (n := integer(lane, "id")) != 0:
                sides[1 if n > 0 else -1] = (section, start)
        full.append((start, sides))
    ends = [s for s, _ in found[1:]] + [length]
    # Sections without length cannot be driven on; files have them at ends of roads.
    return [f for f, end in zip(full, ends, strict=True) if end - f[0] > SAME_S]


def _sample_places(
    element: ET.Element, plan: PlanView, length: float, sections: list[float]
) -> Float:
    """Sampled positions of a road: every start of a record, and regular ones in between."""
    breaks = {0.0, length, *sections}
    for record in element.iter():
        if record.tag in ("elevation", "superelevation", "laneOffset", "geometry"):
            breaks.add(number(record, "s"))
    steps = set(_lateral(element.findall("lanes/laneOffset")).steps())
    for section in element.findall("lanes/laneSection"):
        base = number(section, "s")
        for lane in section.findall("*/lane"):
            for tag in ("width", "border"):
                records = lane.findall(tag)
                breaks |= {base + number(r, "sOffset", 0.0) for r in records}
                steps |= set(_lateral(records, start="sOffset", base=base).steps())
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
        raise MapError(f"needs {len(found)} samples, above {MAX_SAMPLES}")
    return found


def _lateral(elements: list[ET.Element], *, start: str = "s", base: float = 0.0) -> Profile:
    """The profile of a lane offset, width or border; a step between two records is one step."""
    return read_profile(elements, start=start, base=base, shortest=SAME_START_M)


@dataclass(frozen=True)
class _Stretch:
    """Geometry of a lane section: its road and name, the sampled positions, t of its centre line.

    ``base`` is the start of the <laneSection> with the lanes, from which their offsets count [m].
    """

    road: OpenDriveRoad
    name: str
    start: float
    end: float
    s: Float
    middle: Float
    left_out: LeftOut
    base: float = 0.0

    def profile(self, elements: list[ET.Element]) -> Float:
        """Values [M] of records that begin at their ``sOffset``."""
        records = _lateral(elements, start="sOffset", base=self.base)
        return records.at(self.s, since=self.start, until=self.end)


def _read_section(sides: Sides, stretch: _Stretch) -> Section:
    section = Section(stretch.s)
    for side, (element, base) in sorted(sides.items()):
        at = replace(stretch, base=base)
        by_number = {integer(lane, "id"): lane for lane in element.findall("*/lane")}
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
    width = at.profile(lane.findall("width"))
    if (width < -SAME_LENGTH_M).any():
        kind = "lanes with a width below 0 in places, which is read as 0"
        at.left_out[kind].append(f"{at.name}.{lane.get('id')}")
    outer: Float = inner + side * np.maximum(width, 0.0)
    return outer


def _section_lane(lane: ET.Element, n: int, rims: tuple[Float, Float], at: _Stretch) -> SectionLane:
    links = {}
    for link in ("predecessor", "successor"):
        found = lane.find(f"link/{link}")
        if found is not None:
            links[link] = integer(found, "id")
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
        passed = [m for m in marks if at.base + number(m, "sOffset", 0.0) <= at.start + SAME_S]
        marks = passed[-1:] or marks
    return marks[0] if marks else None


def _speed_limit(lane: ET.Element, at: _Stretch) -> float | None:
    """Speed limit of the lane at the middle of its section, otherwise of the road there."""
    middle = (at.start + at.end) / 2
    own = [(at.base + number(e, "sOffset", 0.0), e) for e in lane.findall("speed")]
    types = [(number(e, "s", 0.0), e) for e in at.road.element.findall("type")]
    of_road = [(s, speed) for s, e in types if (speed := e.find("speed")) is not None]
    for records in (own, of_road):
        before = [(s, e) for s, e in records if s <= middle]
        if before:
            name = f"{at.name}.{lane.get('id')}"
            with at.left_out.damaged("lanes without their speed limit", name):
                return _speed(max(before, key=lambda record: record[0])[1])
            return None
    return None


def _speed(element: ET.Element) -> float | None:
    given, unit = element.get("max", ""), element.get("unit", "")
    if given.lower() in ("no limit", "undefined"):
        return None
    if unit.lower() not in SPEED_UNITS:
        raise MapError(
            f"its unit is {unit[:40]!r}; allowed: {', '.join(u for u in SPEED_UNITS if u)}"
        )
    value = number(element, "max")
    if value <= 0:
        raise MapError(f"it is {given!r}, not above 0")
    return value * SPEED_UNITS[unit.lower()]
