"""The gallery of corner cases: storyboards with parameters, for any scene with a road ahead.

All cases are relative to the ego's start and lane, so they fit every scene; speeds are in m/s.
Families and values follow Euro NCAP's test protocols of 2023 (AEB car-to-car, AEB/LSS vulnerable
road user, lane support), rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from real2sim_proto.storyboard import Storyboard

Fields = dict[str, Any]
PICTURES = Path(__file__).parent / "pictures"


@dataclass(frozen=True)
class CornerCase:
    """A case of the gallery.

    Attributes:
        name: unique name.
        title: description in one sentence.
        family: one of ``FAMILIES``.
        parameters: their defaults; lengths in m, speeds in m/s, times in s.
        make: builds the storyboard's fields.
    """

    name: str
    title: str
    family: str
    parameters: Mapping[str, float]
    make: Callable[[], Fields]

    def storyboard(self, **parameters: float) -> Storyboard:
        """The storyboard with other values for some parameters.

        Raises:
            ValueError: the case has no parameter of that name.
        """
        if unknown := sorted(set(parameters) - set(self.parameters)):
            raise ValueError(
                f"corner case {self.name!r} has no parameter {unknown[0]!r}; it has: "
                f"{', '.join(self.parameters)}"
            )
        values = {**self.parameters, **{k: float(v) for k, v in parameters.items()}}
        return Storyboard.model_validate(
            {**self.make(), "name": self.title, "author": "Real2Sim", "parameters": values,
             "date": "2026-01-01T00:00:00"}
        )  # fmt: skip


GALLERY: dict[str, CornerCase] = {}
"""Cases by name."""

FAMILIES = {
    "ahead": "keeping a distance and braking for what is ahead",
    "lanes": "lane changes of others, and keeping the lane",
    "oncoming": "traffic that comes towards the ego",
    "crossing": "road users that cross the ego's path",
}
"""What the cases of each family test."""


def corner_case(name: str) -> CornerCase:
    """The case with a name, with or without the prefix ``gallery:``.

    Raises:
        ValueError: the gallery has no such case.
    """
    found = GALLERY.get(name.removeprefix("gallery:"))
    if found is None:
        raise ValueError(f"the gallery has no {name!r}; it has: {', '.join(GALLERY)}")
    return found


def shipped_picture(name: str) -> bytes:
    """The picture of a case, an SVG document made by `scenarios.picture`.

    Raises:
        ValueError: the gallery has no such case.
    """
    return (PICTURES / f"{corner_case(name).name}.svg").read_bytes()


def case(
    family: str, title: str, **parameters: float
) -> Callable[[Callable[[], Fields]], Callable[[], Fields]]:
    """Add a function that makes a storyboard's fields to the gallery, under the function's name."""

    def register(make: Callable[[], Fields]) -> Callable[[], Fields]:
        name = make.__name__
        GALLERY[name] = CornerCase(name, title, family, parameters, make)
        return make

    return register


# --- Parts ---------------------------------------------------------------------------------------

EGO = {"size": (4.6, 1.85, 1.6), "centre": (1.35, 0.0, 0.8)}
"""Default vehicle box of scenes without one."""

CAR = {"size": (4.5, 1.85, 1.5), "centre": (1.35, 0.0, 0.75)}
VAN = {"size": (5.4, 2.0, 2.3), "centre": (1.6, 0.0, 1.15)}
MOTORCYCLE = {"size": (2.1, 0.8, 1.6), "centre": (0.0, 0.0, 0.8)}
ADULT = {"size": (0.5, 0.6, 1.8), "centre": (0.0, 0.0, 0.9)}
CHILD = {"size": (0.4, 0.5, 1.2), "centre": (0.0, 0.0, 0.6)}
CYCLIST = {"size": (1.8, 0.6, 1.8), "centre": (0.0, 0.0, 0.9)}
DEER = {"size": (1.4, 0.5, 1.2), "centre": (0.0, 0.0, 0.6)}
DEBRIS = {"size": (0.8, 0.8, 0.5), "centre": (0.0, 0.0, 0.25)}
MASSES = {
    "pedestrian": 75.0, "cyclist": 90.0, "van": 2200.0, "motorcycle": 280.0, "animal": 60.0,
    "obstacle": 20.0,
}  # fmt: skip
"""Mass by category, except cars [kg]."""

EGO_WIDTH = 1.85
"""Width of the ego, for impact positions as a share of it [m]."""

ALONG = {"h": 0.0, "relative": True}
"""Orientation along the ego's road, also in lanes on its left."""

AGAINST = {"h": 3.141592653589793, "relative": True}


def ahead(ds: Any, *, lanes: int = 0, offset: Any = 0.0, **more: Any) -> Fields:
    """A position ahead of the ego, in its lane or ``lanes`` lanes to the left."""
    return {
        "kind": "relative_lane", "entity": "Ego", "along": "road", "lanes": lanes, "ds": ds,
        "offset": offset, **more,
    }  # fmt: skip


def beside(ds: Any, dt: Any, h: Any = 0.0) -> Fields:
    """A position relative to the ego along and to the left of the road, facing against its
    direction.
    """
    return {
        "kind": "relative_road", "entity": "Ego", "ds": ds, "dt": dt,
        "orientation": {"h": h, "relative": True},
    }  # fmt: skip


def from_entity(entity: str, dx: Any, dy: Any = 0.0) -> Fields:
    """A position along and to the left of an entity's own axes."""
    return {"kind": "relative_object", "entity": entity, "dx": dx, "dy": dy}


def put(entity: str, position: Fields, speed: Any = 0.0) -> list[Fields]:
    """Initial position and speed of an entity."""
    return [
        {"entity": entity, "action": {"kind": "teleport", "position": position}},
        {"entity": entity, "action": {"kind": "speed", "speed": speed}},
    ]


def speed_to(speed: Any, rate: Any) -> Fields:
    """Change to a speed with constant acceleration [m/s^2]."""
    how = {"shape": "linear", "dimension": "rate", "value": rate}
    return {"kind": "speed", "speed": speed, "dynamics": how}


def change(lanes: int, entity: str, seconds: Any) -> Fields:
    """Change to the lane ``lanes`` to the left of an entity's lane."""
    how = {"shape": "sinusoidal", "dimension": "time", "value": seconds}
    return {"kind": "lane_change", "lane": lanes, "relative_to": entity, "dynamics": how}


def when(test: Fields, **more: Any) -> Fields:
    """A trigger of one condition."""
    return {"groups": [{"conditions": [{"name": test["kind"], "test": test, **more}]}]}


def after(seconds: Any) -> Fields:
    """Triggered a time after the start of the episode."""
    return when({"kind": "simulation_time", "rule": "greater_or_equal", "value": seconds})


def done(event: str) -> Fields:
    """Triggered when an event is complete."""
    return when(
        {"kind": "element_state", "element_type": "event", "element": event, "state": "complete"}
    )


def near(entity: str, gap: Any, *, of: str = "Ego") -> Fields:
    """Triggered at a distance of the ego along the lane, bumper to bumper."""
    return when(
        {
            "kind": "relative_distance", "entities": [of], "entity": entity,
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal", "value": gap,
        }
    )  # fmt: skip


def in_time(entity: str, seconds: Any) -> Fields:
    """Triggered when the ego's front is ``seconds`` from an entity."""
    return when(
        {
            "kind": "time_to_collision", "entities": ["Ego"], "entity": entity,
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal",
            "value": seconds,
        }
    )  # fmt: skip


def event(name: str, start: Fields, *actions: Fields) -> Fields:
    """An event: actions with a start trigger."""
    return {
        "name": name, "start": start,
        "actions": [{"name": f"{name}_{a['kind']}", "action": a} for a in actions],
    }  # fmt: skip


def board(
    entities: list[tuple[str, str, Fields]], init: list[Fields], **events: list[Fields]
) -> Fields:
    """Storyboard fields from entities (name, category, box) and events by entity."""
    groups = [
        {
            "name": f"{name}_group", "entities": [name],
            "maneuvers": [{"name": f"{name}_maneuver", "events": of}],
        }
        for name, of in events.items()
    ]  # fmt: skip
    stories = [{"name": "story", "acts": [{"name": "act", "groups": groups}]}] if groups else []
    made = [
        {"name": n, "category": c, "box": b, "model": c, "mass": MASSES.get(c, 1500.0)}
        for n, c, b in entities
    ]
    ego = {"name": "Ego", "kind": "ego", "box": EGO, "model": "ego"}
    return {"entities": [ego, *made], "init": init, "stories": stories}


# The corner cases of the gallery.


@case("ahead", "CCRs: a stationary car in the ego's lane", gap=40.0, offset=0.0)
def ccrs() -> Fields:
    """Euro NCAP CCRs."""
    return board([("target", "car", CAR)], put("target", ahead("$gap", offset="$offset")))


@case("ahead", "CCRm: a slower car drives ahead in the ego's lane", gap=30.0, speed=5.6, offset=0.0)
def ccrm() -> Fields:
    """Euro NCAP CCRm."""
    init = put("target", ahead("$gap", offset="$offset"), "$speed")
    return board([("target", "car", CAR)], init)


@case("ahead", "CCRb: the car ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=6.0)
def ccrb() -> Fields:
    """Euro NCAP CCRb."""
    init = put("target", ahead("${$gap + 6}"), "$speed")
    brake = event("brake", after("$delay"), speed_to(0.0, "$braking"))
    return board([("target", "car", CAR)], init, target=[brake])


@case("ahead", "CMRb: the motorcycle ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=4.0)
def cmrb() -> Fields:
    """Euro NCAP CMRb."""
    init = put("rider", ahead("${$gap + 6}"), "$speed")
    brake = event("brake", after("$delay"), speed_to(0.0, "$braking"))
    return board([("rider", "motorcycle", MOTORCYCLE)], init, rider=[brake])


@case(
    "ahead",
    "Hard brake: the car ahead brakes hard once the ego is near",
    gap=15.0,
    speed=7.0,
    braking=8.0,
)
def hard_brake() -> Fields:
    """Triggered by the gap, not by time."""
    init = put("target", ahead(30.0), "$speed")
    brake = event("brake", near("target", "$gap"), speed_to(0.0, "$braking"))
    return board([("target", "car", CAR)], init, target=[brake])


@case("ahead", "Stop and go: the lead vehicle slows to a crawl and accelerates again",
    gap=15.0, speed=8.0, slow=1.0, seconds=3.0,
)  # fmt: skip
def stop_and_go() -> Fields:
    """A queue with linearly changing speeds."""
    init = put("target", ahead("${$gap + 6}"), "$speed")
    points = [("$seconds", "$slow"), (2.0, "$slow"), ("$seconds", "$speed")]
    profile = {
        "kind": "speed_profile",
        "points": [{"time": time, "speed": speed} for time, speed in points],
    }
    return board([("target", "car", CAR)], init, target=[event("slow_down", after(1.0), profile)])


@case("ahead", "Debris in the ego's lane", gap=45.0, offset=0.3)
def debris() -> Fields:
    """Too high to drive over."""
    return board([("debris", "obstacle", DEBRIS)], put("debris", ahead("$gap", offset="$offset")))


@case("ahead", "CBLA: a cyclist rides ahead in the ego's lane", gap=30.0, speed=4.2, offset=-0.4)
def cbla() -> Fields:
    """Euro NCAP CBLA."""
    init = put("cyclist", ahead("$gap", offset="$offset"), "$speed")
    return board([("cyclist", "cyclist", CYCLIST)], init)


@case("ahead", "CPLA: an adult walks ahead in the ego's lane", gap=35.0, speed=1.39, offset=-0.8)
def cpla() -> Fields:
    """Euro NCAP CPLA."""
    init = put("adult", ahead("$gap", offset="$offset"), "$speed")
    return board([("adult", "pedestrian", ADULT)], init)


# --- Lanes ---------------------------------------------------------------------------------------


@case(
    "lanes", "Cut-in: a car moves in from the left, close ahead", gap=12.0, speed=7.0, duration=2.0
)
def cut_in() -> Fields:
    """Slower than the ego, so that its gap shrinks."""
    init = put("cutter", ahead(35.0, lanes=1, orientation=ALONG), "$speed")
    move = event("move_in", near("cutter", "$gap"), change(0, "Ego", "$duration"))
    return board([("cutter", "car", CAR)], init, cutter=[move])


@case("lanes", "Cut-in and brake: a car moves in close ahead, and brakes there",
    gap=10.0, speed=8.0, duration=1.5, braking=6.0,
)  # fmt: skip
def cut_in_brake() -> Fields:
    """Brakes as soon as it is in the ego's lane."""
    init = put("cutter", ahead(25.0, lanes=1, orientation=ALONG), "$speed")
    move = event("move_in", near("cutter", "$gap"), change(0, "Ego", "$duration"))
    brake = event("brake", done("move_in"), speed_to(0.0, "$braking"))
    return board([("cutter", "car", CAR)], init, cutter=[move, brake])


@case(
    "lanes",
    "Cut-out: the lead vehicle leaves the lane before a stationary car",
    gap=14.0,
    speed=9.0,
    reveal=25.0,
)
def cut_out() -> Fields:
    """A van hides a stationary object until it leaves the lane."""
    init = put("leader", ahead("${$gap + 6}"), "$speed")
    init += put("standing", ahead(80.0))
    far = near("standing", "$reveal", of="leader")
    out = event("move_out", far, change(1, "leader", 2.0))
    entities = [("leader", "van", VAN), ("standing", "car", CAR)]
    return board(entities, init, leader=[out])


@case("lanes", "Pull out: a parked car pulls out before the ego",
    ahead=45.0, time=2.0, acceleration=2.5, speed=6.0, length=10.0,
)  # fmt: skip
def pull_out() -> Fields:
    """Pulls out from the roadside; its lateral motion depends on the driven distance."""
    init = put("parked", beside("$ahead", -2.8))
    how = {"shape": "sinusoidal", "dimension": "distance", "value": "$length"}
    aside = {"kind": "lane_change", "lane": 0, "relative_to": "Ego", "dynamics": how}
    out = event("pull_out", in_time("parked", "$time"), speed_to("$speed", "$acceleration"), aside)
    return board([("parked", "car", CAR)], init, parked=[out])


@case("lanes", "LSS overtaking: a faster car overtakes and comes back close ahead",
    behind=20.0, speed=15.0, duration=2.5,
)  # fmt: skip
def lss_overtaking() -> Fields:
    """Euro NCAP's overtaking vehicle, but with an early return."""
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


@case("lanes", "LSS lane keeping: the ego begins headed over the line", offset=0.5, heading=0.05)
def lss_keep() -> Fields:
    """Euro NCAP's lateral drift of 0.2 to 0.6 m/s: 0.02 to 0.06 rad at 10 m/s."""
    there = ahead(0.0, offset="$offset", orientation={"h": "$heading", "relative": True})
    return board([], [{"entity": "Ego", "action": {"kind": "teleport", "position": there}}])


# --- Oncoming ------------------------------------------------------------------------------------


@case("oncoming", "Wrong way: a car comes towards the ego in its lane", ahead=90.0, speed=8.0)
def wrong_way() -> Fields:
    """Drives against the traffic in the middle of the lane."""
    against = ahead("$ahead", orientation=AGAINST)
    return board([("ghost", "car", CAR)], put("ghost", against, "$speed"))


@case(
    "oncoming",
    "CCFhos: a car comes towards the ego, half in its lane",
    ahead=120.0,
    speed=13.9,
    offset=0.9,
)
def ccfhos() -> Fields:
    """Euro NCAP CCFhos: head-on, straight, 50 % overlap."""
    against = ahead("$ahead", offset="$offset", orientation=AGAINST)
    return board([("target", "car", CAR)], put("target", against, "$speed"))


@case("oncoming", "CCFhol: an oncoming car overtakes and comes into the ego's lane",
    ahead=120.0, speed=11.0, slow=6.0, distance=80.0, duration=2.0,
)  # fmt: skip
def ccfhol() -> Fields:
    """Euro NCAP CCFhol: head-on, lane change; here the other car changes lanes."""
    there = ahead("${$ahead - 30}", lanes=1, orientation=AGAINST)
    init = put("overtaken", there, "$slow")
    init += put("overtaker", ahead("$ahead", lanes=1, orientation=AGAINST), "$speed")
    out = event("move_out", near("overtaker", "$distance"), change(0, "Ego", "$duration"))
    entities = [("overtaken", "van", VAN), ("overtaker", "car", CAR)]
    return board(entities, init, overtaker=[out])


@case("oncoming", "LSS oncoming: an oncoming car drifts over into the ego's lane",
    ahead=90.0, speed=8.0, distance=45.0, drift=2.0,
)  # fmt: skip
def lss_oncoming() -> Fields:
    """Euro NCAP's oncoming vehicle, but drifting."""
    init = put("oncoming", ahead("$ahead", lanes=1, orientation=AGAINST), "$speed")
    how = {"shape": "sinusoidal", "acceleration": 0.8}
    aside = {"kind": "lane_offset", "offset": "$drift", **how}
    return board(
        [("oncoming", "car", CAR)], init,
        oncoming=[event("drift", near("oncoming", "$distance"), aside)],
    )  # fmt: skip


@case("oncoming", "CCFtap: an oncoming car that waits turns left across the ego's path",
    ahead=50.0, time=2.2, radius=7.0, acceleration=3.0, speed=7.0,
)  # fmt: skip
def ccftap() -> Fields:
    """Euro NCAP CCFtap: front turn across path; here the other car turns.

    By default it is in the middle of the ego's lane when the ego arrives.
    """
    init = put("turner", ahead("${$ahead + $radius}", lanes=1, orientation=AGAINST))
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


# --- Crossing ------------------------------------------------------------------------------------

# A crossing actor starts when the ego reaches the distance at which both meet. The actor is then at
# a share of the ego's width, measured from the side that it comes from.

NEAR, FAR = -1.0, 1.0
"""Side that the actor comes from: right or left."""


@case(
    "crossing",
    "CPNA: an adult crosses from the near side",
    ahead=45.0,
    distance=4.0,
    speed=1.39,
    impact=0.5,
)
def cpna() -> Fields:
    """Euro NCAP CPNA-50."""
    return _crossing("pedestrian", ADULT, NEAR)


@case("crossing", "CPNA-25: an adult from the near side, hit at a quarter of the ego's width",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.25,
)  # fmt: skip
def cpna_25() -> Fields:
    """Euro NCAP CPNA-25."""
    return _crossing("pedestrian", ADULT, NEAR)


@case("crossing", "CPNA-75: an adult from the near side, hit at three quarters of the ego's width",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.75,
)  # fmt: skip
def cpna_75() -> Fields:
    """Euro NCAP CPNA-75."""
    return _crossing("pedestrian", ADULT, NEAR)


@case(
    "crossing",
    "CPFA: an adult runs across from the far side",
    ahead=45.0,
    distance=6.0,
    speed=2.22,
    impact=0.5,
)
def cpfa() -> Fields:
    """Euro NCAP CPFA-50."""
    return _crossing("pedestrian", ADULT, FAR)


@case("crossing", "Occluded pedestrian (CPNCO): a child comes out between parked cars",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.5,
)  # fmt: skip
def occluded_pedestrian() -> Fields:
    """Euro NCAP CPNCO-50."""
    return _crossing("pedestrian", CHILD, NEAR, hidden=True)


@case("crossing", "Hesitating pedestrian: an adult stops in the ego's lane, then continues",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.5, stop=3.2, pause=1.5,
)  # fmt: skip
def hesitating_pedestrian() -> Fields:
    """Stops after a distance, for a duration."""
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
    "crossing",
    "CBNA: a cyclist crosses from the near side",
    ahead=50.0,
    distance=17.0,
    speed=4.17,
    impact=0.5,
)
def cbna() -> Fields:
    """Euro NCAP CBNA-50."""
    return _crossing("cyclist", CYCLIST, NEAR)


@case(
    "crossing",
    "CBFA: a cyclist crosses from the far side",
    ahead=50.0,
    distance=17.0,
    speed=4.17,
    impact=0.5,
)
def cbfa() -> Fields:
    """Euro NCAP CBFA-50."""
    return _crossing("cyclist", CYCLIST, FAR)


@case(
    "crossing",
    "Animal: a deer runs across from the near side",
    ahead=50.0,
    distance=9.0,
    speed=6.0,
    impact=0.5,
)
def animal() -> Fields:
    """Speed of a trotting roe deer."""
    return _crossing("animal", DEER, NEAR)


@case("crossing", "Junction crossing (CCCscp): a car crosses so that both arrive together",
    ahead=45.0, distance=35.0, speed=8.0,
)  # fmt: skip
def junction_crossing() -> Fields:
    """Constant motion independent of the ego, until they meet."""
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
