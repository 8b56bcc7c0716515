"""Ready corner cases: storyboards with parameters, for any scene with a road ahead.

All are relative to where the ego begins and to its lane, so that they fit every scene; speeds are
in m/s. Families and figures follow Euro NCAP's test protocols of 2023 (AEB car-to-car, AEB/LSS
vulnerable road user, lane support), rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from real2sim_proto.storyboard import Storyboard

Fields = dict[str, Any]

CAR = {"size": (4.5, 1.85, 1.5), "centre": (1.35, 0.0, 0.75)}
VAN = {"size": (5.4, 2.0, 2.3), "centre": (1.6, 0.0, 1.15)}
TRUCK = {"size": (8.0, 2.5, 3.2), "centre": (2.5, 0.0, 1.6)}
ADULT = {"size": (0.5, 0.6, 1.8), "centre": (0.0, 0.0, 0.9)}
CHILD = {"size": (0.4, 0.5, 1.2), "centre": (0.0, 0.0, 0.6)}
CYCLIST = {"size": (1.8, 0.6, 1.8), "centre": (0.0, 0.0, 0.9)}
MASSES = {"pedestrian": 75.0, "cyclist": 90.0, "van": 2200.0, "obstacle": 20.0}
"""By category, where it is no car [kg]."""
DEBRIS = {"size": (0.8, 0.8, 0.5), "centre": (0.0, 0.0, 0.25)}

ALONG = {"h": 0.0, "relative": True}
"""In the direction of the ego's road, also in lanes on its left."""


@dataclass(frozen=True)
class CornerCase:
    """One of the gallery.

    Attributes:
        name: to ask for it by.
        title: what happens, in a sentence.
        parameters: their defaults.
        make: the storyboard's fields.
    """

    name: str
    title: str
    parameters: Mapping[str, float]
    make: Callable[[], Fields]

    def storyboard(self, **parameters: float) -> Storyboard:
        """The storyboard with other values for some parameters.

        Raises:
            ValueError: a parameter that it does not have.
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
"""By name."""


def corner_case(name: str) -> CornerCase:
    """The case of a name, with or without the prefix ``gallery:``.

    Raises:
        ValueError: there is none.
    """
    found = GALLERY.get(name.removeprefix("gallery:"))
    if found is None:
        raise ValueError(f"the gallery has no {name!r}; it has: {', '.join(GALLERY)}")
    return found


def _case(title: str, **parameters: float) -> Callable[[Callable[[], Fields]], None]:
    def register(make: Callable[[], Fields]) -> None:
        name = make.__name__.removeprefix("_")
        GALLERY[name] = CornerCase(name, title, parameters, make)

    return register


# --- parts ------------------------------------------------------------------------------------


def _ahead(ds: Any, *, lanes: int = 0, offset: Any = 0.0, **more: Any) -> Fields:
    return {
        "kind": "relative_lane", "entity": "Ego", "lanes": lanes, "ds": ds, "offset": offset,
        **more,
    }  # fmt: skip


def _beside(ds: Any, dt: Any, h: Any = 0.0) -> Fields:
    """A place along and left of the road from the ego, headed against the road's direction."""
    return {
        "kind": "relative_road", "entity": "Ego", "ds": ds, "dt": dt,
        "orientation": {"h": h, "relative": True},
    }  # fmt: skip


def _from(entity: str, dx: Any) -> Fields:
    return {"kind": "relative_object", "entity": entity, "dx": dx, "dy": 0.0}


def _put(entity: str, position: Fields, speed: Any = 0.0) -> list[Fields]:
    return [
        {"entity": entity, "action": {"kind": "teleport", "position": position}},
        {"entity": entity, "action": {"kind": "speed", "speed": speed}},
    ]


def _to(speed: Any, rate: Any) -> Fields:
    how = {"shape": "linear", "dimension": "rate", "value": rate}
    return {"kind": "speed", "speed": speed, "dynamics": how}


def _change(lanes: int, entity: str, seconds: Any) -> Fields:
    how = {"shape": "sinusoidal", "dimension": "time", "value": seconds}
    return {"kind": "lane_change", "lane": lanes, "relative_to": entity, "dynamics": how}


def _when(test: Fields, **more: Any) -> Fields:
    return {"groups": [{"conditions": [{"name": test["kind"], "test": test, **more}]}]}


def _after(seconds: Any) -> Fields:
    return _when({"kind": "simulation_time", "rule": "greater_or_equal", "value": seconds})


def _near(entity: str, gap: Any) -> Fields:
    """Once the ego is so near to it along the lane, bumper to bumper."""
    return _when(
        {
            "kind": "relative_distance", "entities": ["Ego"], "entity": entity,
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal", "value": gap,
        }
    )  # fmt: skip


def _in_time(entity: str, seconds: Any) -> Fields:
    """Once the ego would be at the place of an entity in so many seconds."""
    return _when(
        {
            "kind": "time_headway", "entities": ["Ego"], "entity": entity,
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal",
            "value": seconds,
        }
    )  # fmt: skip


def _event(name: str, start: Fields, *actions: Fields) -> Fields:
    return {
        "name": name, "start": start,
        "actions": [{"name": f"{name}_{a['kind']}", "action": a} for a in actions],
    }  # fmt: skip


def _board(
    entities: list[tuple[str, str, Fields]], init: list[Fields], **events: list[Fields]
) -> Fields:
    """Of entities (name, category, box), and of events by entity."""
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
    ego = {"name": "Ego", "kind": "ego", "box": CAR, "model": "ego"}
    return {"entities": [ego, *made], "init": init, "stories": stories}


def _crossing(category: str, box: Fields, side: float, *, hidden: bool = False) -> Fields:
    """Somebody crosses so that both meet at the ego's lane, unless the ego reacts."""
    heading = -side * 1.5707963267948966
    start = _beside("$ahead", f"${{{side} * $distance}}", heading)
    walk = {
        "kind": "follow_trajectory",
        "name": "crossing",
        "curve": {
            "shape": "polyline",
            "vertices": [
                {"time": 0.0, "position": _from("crosser", 0.0)},
                {"time": 0.0, "position": _from("crosser", "${2 * $distance}")},
            ],
        },
    }
    init = _put("crosser", start)
    entities = [("crosser", category, box)]
    if hidden:
        parked = [("parked_1", -9.0), ("parked_2", -2.6 - 1.35 - 2.25)]
        for name, behind in parked:
            init += _put(name, _beside(f"${{$ahead + {behind}}}", side * 3.0))
            entities.append((name, "car", CAR))
    # When it begins it needs distance / speed to the middle of the ego's lane.
    at = _when(
        {
            "kind": "time_to_collision", "entities": ["Ego"], "entity": "crosser",
            "measure": "longitudinal", "rule": "less_or_equal", "value": "${$distance / $speed}",
        }
    )  # fmt: skip
    walking = {"kind": "speed", "speed": "$speed"}
    return _board(entities, init, crosser=[_event("cross", at, walk, walking)])


# --- cars ahead -------------------------------------------------------------------------------


@_case("CCRs: a car stands in the ego's lane", gap=40.0, offset=0.0)
def _ccrs() -> Fields:
    return _board([("target", "car", CAR)], _put("target", _ahead("$gap", offset="$offset")))


@_case("CCRm: a slower car drives ahead in the ego's lane", gap=30.0, speed=5.6, offset=0.0)
def _ccrm() -> Fields:
    init = _put("target", _ahead("$gap", offset="$offset"), "$speed")
    return _board([("target", "car", CAR)], init)


@_case("CCRb: the car ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=6.0)
def _ccrb() -> Fields:
    init = _put("target", _ahead("${$gap + 6}"), "$speed")
    brake = _event("brake", _after("$delay"), _to(0.0, "$braking"))
    return _board([("target", "car", CAR)], init, target=[brake])


@_case(
    "Hard brake: the car ahead brakes hard once the ego is near", gap=15.0, speed=7.0, braking=8.0
)
def _hard_brake() -> Fields:
    init = _put("target", _ahead(30.0), "$speed")
    brake = _event("brake", _near("target", "$gap"), _to(0.0, "$braking"))
    return _board([("target", "car", CAR)], init, target=[brake])


@_case("Cut-in: a car moves in from the left, close ahead", gap=12.0, speed=7.0, duration=2.0)
def _cut_in() -> Fields:
    init = _put("cutter", _ahead(35.0, lanes=1, orientation=ALONG), "$speed")
    move = _event("move_in", _near("cutter", "$gap"), _change(0, "Ego", "$duration"))
    return _board([("cutter", "car", CAR)], init, cutter=[move])


@_case("Cut-out: the car ahead moves out before one that stands", gap=14.0, speed=9.0, reveal=25.0)
def _cut_out() -> Fields:
    init = _put("leader", _ahead("${$gap + 6}"), "$speed")
    init += _put("standing", _ahead(80.0))
    far = _when(
        {
            "kind": "relative_distance", "entities": ["leader"], "entity": "standing",
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal",
            "value": "$reveal",
        }
    )  # fmt: skip
    out = _event("move_out", far, _change(1, "leader", 2.0))
    entities = [("leader", "van", VAN), ("standing", "car", CAR)]
    return _board(entities, init, leader=[out])


@_case("Debris lies in the ego's lane", gap=45.0, offset=0.3)
def _debris() -> Fields:
    return _board(
        [("debris", "obstacle", DEBRIS)], _put("debris", _ahead("$gap", offset="$offset"))
    )


# --- oncoming ---------------------------------------------------------------------------------


@_case("Wrong way: a car comes towards the ego in its lane", ahead=90.0, speed=8.0)
def _wrong_way() -> Fields:
    against = _ahead("$ahead", orientation={"h": 3.141592653589793, "relative": True})
    return _board([("ghost", "car", CAR)], _put("ghost", against, "$speed"))


@_case(
    "LSS oncoming: an oncoming car drifts over into the ego's lane",
    ahead=90.0, speed=8.0, distance=45.0, drift=2.0,
)  # fmt: skip
def _lss_oncoming() -> Fields:
    init = _put("oncoming", _ahead("$ahead", lanes=1), "$speed")
    how = {"shape": "sinusoidal", "acceleration": 0.8}
    aside = {"kind": "lane_offset", "offset": "$drift", **how}
    return _board(
        [("oncoming", "car", CAR)], init,
        oncoming=[_event("drift", _near("oncoming", "$distance"), aside)],
    )  # fmt: skip


@_case(
    "LSS overtaking: a faster car overtakes and comes back close ahead",
    behind=20.0, speed=15.0, duration=2.5,
)  # fmt: skip
def _lss_overtaking() -> Fields:
    init = _put("overtaker", _ahead("${-1 * $behind}", lanes=1, orientation=ALONG), "$speed")
    past = _when(
        {
            "kind": "distance", "entities": ["overtaker"], "measure": "euclidean",
            "position": {"kind": "relative_object", "entity": "Ego", "dx": 9.0, "dy": 3.5},
            "rule": "less_or_equal", "value": 2.5,
        }
    )  # fmt: skip
    back = _event("come_back", past, _change(0, "Ego", "$duration"))
    return _board([("overtaker", "car", CAR)], init, overtaker=[back])


# --- crossing ---------------------------------------------------------------------------------


@_case("CPNA: an adult crosses from the near side", ahead=45.0, distance=4.0, speed=1.39)
def _cpna() -> Fields:
    return _crossing("pedestrian", ADULT, -1.0)


@_case("CPFA: an adult runs across from the far side", ahead=45.0, distance=6.0, speed=2.22)
def _cpfa() -> Fields:
    return _crossing("pedestrian", ADULT, 1.0)


@_case(
    "Occluded pedestrian: a child comes out between parked cars",
    ahead=45.0,
    distance=4.0,
    speed=1.39,
)
def _occluded_pedestrian() -> Fields:
    return _crossing("pedestrian", CHILD, -1.0, hidden=True)


@_case("CBNA: a cyclist crosses from the near side", ahead=50.0, distance=17.0, speed=4.17)
def _cbna() -> Fields:
    return _crossing("cyclist", CYCLIST, -1.0)


@_case("CBFA: a cyclist crosses from the far side", ahead=50.0, distance=17.0, speed=4.17)
def _cbfa() -> Fields:
    return _crossing("cyclist", CYCLIST, 1.0)


@_case("CBLA: a cyclist rides ahead in the ego's lane", gap=30.0, speed=4.2, offset=-0.4)
def _cbla() -> Fields:
    init = _put("cyclist", _ahead("$gap", offset="$offset"), "$speed")
    return _board([("cyclist", "cyclist", CYCLIST)], init)


@_case("CPLA: an adult walks ahead in the ego's lane", gap=35.0, speed=1.39, offset=-0.8)
def _cpla() -> Fields:
    init = _put("adult", _ahead("$gap", offset="$offset"), "$speed")
    return _board([("adult", "pedestrian", ADULT)], init)


@_case(
    "Junction crossing: a car crosses so that both arrive together",
    ahead=45.0, distance=35.0, speed=8.0,
)  # fmt: skip
def _junction_crossing() -> Fields:
    start = _beside("$ahead", "${-1 * $distance}", 1.5707963267948966)
    meet = {
        "kind": "synchronize",
        "master": "Ego",
        "master_target": _beside("$ahead", 0.0),
        "target": _beside("$ahead", 0.0),
        "final_speed": "$speed",
    }
    init = _put("crosser", start, "$speed")
    return _board([("crosser", "car", CAR)], init, crosser=[_event("meet", _after(0.0), meet)])
