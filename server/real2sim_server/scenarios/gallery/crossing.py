"""Somebody crosses the ego's way.

Who crosses sets off when the ego's front would be there in the time that it needs to where the ego
is to hit it: at a share of the ego's width, from the side it comes from.
"""

from __future__ import annotations

from .case import Fields, case
from .parts import (
    ADULT,
    CAR,
    CHILD,
    CYCLIST,
    DEER,
    EGO_WIDTH,
    after,
    beside,
    board,
    event,
    from_entity,
    in_time,
    put,
    speed_to,
    when,
)

NEAR, FAR = -1.0, 1.0
"""Side that somebody comes from: right or left."""


@case("CPNA: an adult crosses from the near side", ahead=45.0, distance=4.0, speed=1.39, impact=0.5)
def cpna() -> Fields:
    """Euro NCAP CPNA-50."""
    return _crossing("pedestrian", ADULT, NEAR)


@case(
    "CPNA-25: an adult from the near side, hit at a quarter of the ego's width",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.25,
)  # fmt: skip
def cpna_25() -> Fields:
    """Euro NCAP CPNA-25."""
    return _crossing("pedestrian", ADULT, NEAR)


@case(
    "CPNA-75: an adult from the near side, hit at three quarters of the ego's width",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.75,
)  # fmt: skip
def cpna_75() -> Fields:
    """Euro NCAP CPNA-75."""
    return _crossing("pedestrian", ADULT, NEAR)


@case(
    "CPFA: an adult runs across from the far side", ahead=45.0, distance=6.0, speed=2.22, impact=0.5
)
def cpfa() -> Fields:
    """Euro NCAP CPFA-50."""
    return _crossing("pedestrian", ADULT, FAR)


@case(
    "Occluded pedestrian (CPNCO): a child comes out between parked cars",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.5,
)  # fmt: skip
def occluded_pedestrian() -> Fields:
    """Euro NCAP CPNCO-50."""
    return _crossing("pedestrian", CHILD, NEAR, hidden=True)


@case(
    "Hesitating pedestrian: an adult stops in the ego's lane and goes on",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.5, stop=3.2, pause=1.5,
)  # fmt: skip
def hesitating_pedestrian() -> Fields:
    """Stops after so far, for so long."""
    walked = {"kind": "traversed_distance", "entities": ["crosser"], "value": "$stop"}
    stood = {"kind": "stand_still", "entities": ["crosser"], "duration": "$pause"}
    walking = {"groups": [
        {"conditions": [
            {"name": "stood", "test": stood},
            {"name": "walked", "test": walked},
        ]}
    ]}  # fmt: skip
    return _crossing(
        "pedestrian", ADULT, NEAR, 
        event("stop", when(walked), speed_to(0.0, 4.0)),
        event("go_on", walking, speed_to("$speed", 4.0)),
    )  # fmt: skip


@case(
    "CBNA: a cyclist crosses from the near side", ahead=50.0, distance=17.0, speed=4.17, impact=0.5
)
def cbna() -> Fields:
    """Euro NCAP CBNA-50."""
    return _crossing("cyclist", CYCLIST, NEAR)


@case(
    "CBFA: a cyclist crosses from the far side", ahead=50.0, distance=17.0, speed=4.17, impact=0.5
)
def cbfa() -> Fields:
    """Euro NCAP CBFA-50."""
    return _crossing("cyclist", CYCLIST, FAR)


@case(
    "Animal: a deer runs across from the near side", ahead=50.0, distance=9.0, speed=6.0, impact=0.5
)
def animal() -> Fields:
    """As fast as a roe deer trots."""
    return _crossing("animal", DEER, NEAR)


@case(
    "Junction crossing (CCCscp): a car crosses so that both arrive together",
    ahead=45.0, distance=35.0, speed=8.0,
)  # fmt: skip
def junction_crossing() -> Fields:
    """Whatever the ego does, until they meet."""
    start = beside("$ahead", "${-1 * $distance}", 1.5707963267948966)
    meet = {
        "kind": "synchronize",
        "master": "Ego",
        "master_target": beside("$ahead", 0.0),
        "target": beside("$ahead", 0.0),
        "final_speed": "$speed",
    }
    init = put("crosser", start, "$speed")
    return board([("crosser", "car", CAR)], init, crosser=[event("meet", after(0.0), meet)])


def _crossing(
    category: str, box: Fields, side: float, *more: Fields, hidden: bool = False
) -> Fields:
    heading = -side * 1.5707963267948966
    init = put("crosser", beside("$ahead", f"${{{side} * $distance}}", heading))
    ends = (from_entity("crosser", 0.0), from_entity("crosser", "${2 * $distance}"))
    walk = {
        "kind": "follow_trajectory",
        "name": "crossing",
        "curve": {
            "shape": "polyline",
            "vertices": [{"time": 0.0, "position": end} for end in ends],
        },
    }
    entities = [("crosser", category, box)]
    if hidden:
        parked = [("parked_1", -9.0), ("parked_2", -2.6 - 1.35 - 2.25)]
        for name, behind in parked:
            init += put(name, beside(f"${{$ahead + {behind}}}", side * 3.0))
            entities.append((name, "car", CAR))
    way = f"($distance + ($impact - 0.5) * {EGO_WIDTH})"
    at = in_time("crosser", f"${{{way} / $speed}}")
    cross = event("cross", at, walk, {"kind": "speed", "speed": "$speed"})
    return board(entities, init, crosser=[cross, *more])
