"""Somebody comes towards the ego in its lane, or across it."""

from __future__ import annotations

from .case import Fields, case
from .parts import AGAINST, CAR, VAN, ahead, board, change, event, from_entity, in_time, near, put


@case("Wrong way: a car comes towards the ego in its lane", ahead=90.0, speed=8.0)
def wrong_way() -> Fields:
    """In the middle of the lane, all the way."""
    against = ahead("$ahead", orientation=AGAINST)
    return board([("ghost", "car", CAR)], put("ghost", against, "$speed"))


@case("CCFhos: a car comes towards the ego, half in its lane", ahead=120.0, speed=13.9, offset=0.9)
def ccfhos() -> Fields:
    """Euro NCAP CCFhos: head-on, straight; overlap of a half."""
    against = ahead("$ahead", offset="$offset", orientation=AGAINST)
    return board([("target", "car", CAR)], put("target", against, "$speed"))


@case(
    "CCFhol: an oncoming car overtakes and comes into the ego's lane",
    ahead=120.0, speed=11.0, slow=6.0, distance=80.0, duration=2.0,
)  # fmt: skip
def ccfhol() -> Fields:
    """Euro NCAP CCFhol: head-on, lane change; here it is the other car that changes lanes."""
    init = put("overtaken", ahead("${$ahead - 30}", lanes=1), "$slow")
    init += put("overtaker", ahead("$ahead", lanes=1), "$speed")
    out = event("move_out", near("overtaker", "$distance"), change(0, "Ego", "$duration"))
    entities = [("overtaken", "van", VAN), ("overtaker", "car", CAR)]
    return board(entities, init, overtaker=[out])


@case(
    "LSS oncoming: an oncoming car drifts over into the ego's lane",
    ahead=90.0, speed=8.0, distance=45.0, drift=2.0,
)  # fmt: skip
def lss_oncoming() -> Fields:
    """Euro NCAP's oncoming vehicle, which is the one that drifts here."""
    init = put("oncoming", ahead("$ahead", lanes=1), "$speed")
    how = {"shape": "sinusoidal", "acceleration": 0.8}
    aside = {"kind": "lane_offset", "offset": "$drift", **how}
    return board(
        [("oncoming", "car", CAR)], init,
        oncoming=[event("drift", near("oncoming", "$distance"), aside)],
    )  # fmt: skip


@case(
    "CCFtap: an oncoming car that waits turns left across the ego's path",
    ahead=50.0, time=2.2, radius=7.0, acceleration=3.0, speed=7.0,
)  # fmt: skip
def ccftap() -> Fields:
    """Euro NCAP CCFtap: front turn across path; here it is the other car that turns.

    By default it is in the middle of the ego's lane when the ego comes.
    """
    init = put("turner", ahead("${$ahead + $radius}", lanes=1))
    corner = [(0.0, 0.0, 1.0), ("$radius", 0.0, 0.7071067811865476), ("$radius", "$radius", 1.0)]
    quarter = {
        "shape": "nurbs",
        "order": 3,
        "knots": [0.0, 0.0, 0.0, 1.0, 1.0, 1.0],
        "points": [
            {"position": from_entity("turner", x, y), "weight": weight} for x, y, weight in corner
        ],
    }
    turn = {"kind": "follow_trajectory", "name": "left_turn", "curve": quarter}
    limit = {"shape": "linear", "dimension": "rate", "value": "$acceleration"}
    go = {"kind": "speed", "speed": "$speed", "dynamics": limit}
    start = in_time("turner", "$time")
    return board([("turner", "car", CAR)], init, turner=[event("turn", start, turn, go)])
