"""The true lanes of a street."""

from __future__ import annotations

import numpy as np

from real2sim_proto.lanes import LaneKind

from ..geometry.transform import Float
from ..scene import Area, Lane, LaneGraph, StopLine
from .street import FACADE, KERB, LANE, Street

WALK_WIDTH = FACADE - KERB
STOP_LINE_M, CROSSING_M = 3.15, 1.8
"""How far before and how far around the middle of the pedestrian crossing paint lies [m]."""
SPEED_LIMIT = 13.9


def street_lanes(street: Street) -> LaneGraph:
    """Driving lanes with parking strips and sidewalks beside, the crossing and its stop lines."""
    s = np.arange(street.start, street.end + 1e-9, 1.0)
    parking = KERB - LANE
    strips: list[tuple[str, LaneKind, float, float]] = [
        ("lane", "driving", LANE / 2, LANE),
        ("parking", "parking", LANE + parking / 2, parking),
        ("walk", "sidewalk", KERB + WALK_WIDTH / 2, WALK_WIDTH),
    ]
    lanes = []
    for name, kind, d, width in strips:
        for side, sign in (("right", -1), ("left", 1)):
            line = _line(street, s, sign * d)
            lanes.append(
                Lane(
                    f"{name}_{side}",
                    kind,
                    line if sign < 0 else line[::-1],
                    np.full(len(s), width),
                    speed_limit=SPEED_LIMIT if kind == "driving" else None,
                    opposite=f"lane_{'left' if sign < 0 else 'right'}" if name == "lane" else None,
                    right=f"parking_{side}" if name == "lane" else None,
                    may_change_right=False,
                )
            )
    crossing = _corners(street, street.crossing, CROSSING_M, KERB - 0.4)
    stops = [
        StopLine(
            f"stop_{side}",
            _line(
                street,
                np.full(2, street.crossing + sign * STOP_LINE_M),
                sign * np.array([0.15, LANE - 0.1]),
            ),
            (f"lane_{side}",),
        )
        for side, sign in (("right", -1), ("left", 1))
    ]
    return LaneGraph.of(
        lanes,
        areas=[Area("crossing", "crosswalk", crossing)],
        stop_lines=stops,
        source="synthetic street",
        accuracy=0.0,
    )


def _line(street: Street, s: Float, d: float | Float) -> Float:
    places = street.point(s, d)
    return np.column_stack([places, np.zeros(len(places))])


def _corners(street: Street, s: float, along: float, aside: float) -> Float:
    return _line(
        street,
        np.array([s - along, s + along, s + along, s - along]),
        np.array([-aside, -aside, aside, aside]),
    )
