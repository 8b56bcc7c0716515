"""Somebody on the ego's side of the road changes lanes, or the ego leaves its own."""

from __future__ import annotations

from .case import Fields, case
from .parts import (
    ALONG,
    CAR,
    VAN,
    ahead,
    beside,
    board,
    change,
    done,
    event,
    in_time,
    near,
    put,
    speed_to,
    when,
)


@case("Cut-in: a car moves in from the left, close ahead", gap=12.0, speed=7.0, duration=2.0)
def cut_in() -> Fields:
    """Slower than the ego, so that its gap shrinks."""
    init = put("cutter", ahead(35.0, lanes=1, orientation=ALONG), "$speed")
    move = event("move_in", near("cutter", "$gap"), change(0, "Ego", "$duration"))
    return board([("cutter", "car", CAR)], init, cutter=[move])


@case(
    "Cut-in and brake: a car moves in close ahead, and brakes there",
    gap=10.0, speed=8.0, duration=1.5, braking=6.0,
)  # fmt: skip
def cut_in_brake() -> Fields:
    """Brakes as soon as it is in the ego's lane."""
    init = put("cutter", ahead(25.0, lanes=1, orientation=ALONG), "$speed")
    move = event("move_in", near("cutter", "$gap"), change(0, "Ego", "$duration"))
    brake = event("brake", done("move_in"), speed_to(0.0, "$braking"))
    return board([("cutter", "car", CAR)], init, cutter=[move, brake])


@case("Cut-out: the car ahead moves out before one that stands", gap=14.0, speed=9.0, reveal=25.0)
def cut_out() -> Fields:
    """What stands is hidden by a van until then."""
    init = put("leader", ahead("${$gap + 6}"), "$speed")
    init += put("standing", ahead(80.0))
    far = near("standing", "$reveal", of="leader")
    out = event("move_out", far, change(1, "leader", 2.0))
    entities = [("leader", "van", VAN), ("standing", "car", CAR)]
    return board(entities, init, leader=[out])


@case(
    "Pull out: a parked car pulls out before the ego",
    ahead=45.0, time=2.0, acceleration=2.5, speed=6.0, length=10.0,
)  # fmt: skip
def pull_out() -> Fields:
    """From beside the lane; sideways by the way that it has driven."""
    init = put("parked", beside("$ahead", -2.8))
    how = {"shape": "sinusoidal", "dimension": "distance", "value": "$length"}
    aside = {"kind": "lane_change", "lane": 0, "relative_to": "Ego", "dynamics": how}
    out = event("pull_out", in_time("parked", "$time"), speed_to("$speed", "$acceleration"), aside)
    return board([("parked", "car", CAR)], init, parked=[out])


@case(
    "LSS overtaking: a faster car overtakes and comes back close ahead",
    behind=20.0, speed=15.0, duration=2.5,
)  # fmt: skip
def lss_overtaking() -> Fields:
    """Euro NCAP's overtaking vehicle, which comes back early."""
    init = put("overtaker", ahead("${-1 * $behind}", lanes=1, orientation=ALONG), "$speed")
    past = when(
        {
            "kind": "distance", "entities": ["overtaker"], "measure": "euclidean",
            "position": {"kind": "relative_object", "entity": "Ego", "dx": 9.0, "dy": 3.5},
            "rule": "less_or_equal", "value": 2.5,
        }
    )  # fmt: skip
    back = event("come_back", past, change(0, "Ego", "$duration"))
    return board([("overtaker", "car", CAR)], init, overtaker=[back])


@case("LSS lane keeping: the ego begins headed over the line", offset=0.5, heading=0.05)
def lss_keep() -> Fields:
    """Euro NCAP's drift of 0.2 to 0.6 m/s sideways: at 10 m/s as much as 0.02 to 0.06 rad."""
    there = ahead(0.0, offset="$offset", orientation={"h": "$heading", "relative": True})
    return board([], [{"entity": "Ego", "action": {"kind": "teleport", "position": there}}])
