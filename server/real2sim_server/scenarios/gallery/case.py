"""Corner cases: storyboards with parameters, the list of all, and the parts they are made of."""

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
    """One of the gallery.

    Attributes:
        name: to ask for it by.
        title: what happens, in a sentence.
        family: of what kind it is, such as ``crossing``.
        parameters: their defaults; lengths in m, speeds in m/s, times in s.
        make: the storyboard's fields.
    """

    name: str
    title: str
    family: str
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
"""Of scenes that do not say more of their vehicle."""

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
"""By category, where it is no car [kg]."""

EGO_WIDTH = 1.85
"""Of the ego, where a share of it says what is hit [m]."""

ALONG = {"h": 0.0, "relative": True}
"""In the direction of the ego's road, also in lanes on its left."""

AGAINST = {"h": 3.141592653589793, "relative": True}


def ahead(ds: Any, *, lanes: int = 0, offset: Any = 0.0, **more: Any) -> Fields:
    """A place in the ego's lane, or so many lanes on its left, so far ahead of it."""
    return {
        "kind": "relative_lane", "entity": "Ego", "lanes": lanes, "ds": ds, "offset": offset,
        **more,
    }  # fmt: skip


def beside(ds: Any, dt: Any, h: Any = 0.0) -> Fields:
    """A place along and left of the road from the ego, headed against the road's direction."""
    return {
        "kind": "relative_road", "entity": "Ego", "ds": ds, "dt": dt,
        "orientation": {"h": h, "relative": True},
    }  # fmt: skip


def from_entity(entity: str, dx: Any, dy: Any = 0.0) -> Fields:
    """A place along and left of an entity's own axes."""
    return {"kind": "relative_object", "entity": entity, "dx": dx, "dy": dy}


def put(entity: str, position: Fields, speed: Any = 0.0) -> list[Fields]:
    """Where an entity begins, and how fast."""
    return [
        {"entity": entity, "action": {"kind": "teleport", "position": position}},
        {"entity": entity, "action": {"kind": "speed", "speed": speed}},
    ]


def speed_to(speed: Any, rate: Any) -> Fields:
    """To a speed by a constant acceleration [m/s^2]."""
    how = {"shape": "linear", "dimension": "rate", "value": rate}
    return {"kind": "speed", "speed": speed, "dynamics": how}


def change(lanes: int, entity: str, seconds: Any) -> Fields:
    """Into the lane so many on the left of an entity's."""
    how = {"shape": "sinusoidal", "dimension": "time", "value": seconds}
    return {"kind": "lane_change", "lane": lanes, "relative_to": entity, "dynamics": how}


def when(test: Fields, **more: Any) -> Fields:
    """A trigger of one condition."""
    return {"groups": [{"conditions": [{"name": test["kind"], "test": test, **more}]}]}


def after(seconds: Any) -> Fields:
    """So long after the episode began."""
    return when({"kind": "simulation_time", "rule": "greater_or_equal", "value": seconds})


def done(event: str) -> Fields:
    """Once an event is complete."""
    return when(
        {"kind": "element_state", "element_type": "event", "element": event, "state": "complete"}
    )


def near(entity: str, gap: Any, *, of: str = "Ego") -> Fields:
    """Once the ego is so near to it along the lane, bumper to bumper."""
    return when(
        {
            "kind": "relative_distance", "entities": [of], "entity": entity,
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal", "value": gap,
        }
    )  # fmt: skip


def in_time(entity: str, seconds: Any) -> Fields:
    """Once the ego's front would be at an entity in so many seconds."""
    return when(
        {
            "kind": "time_to_collision", "entities": ["Ego"], "entity": entity,
            "measure": "longitudinal", "freespace": True, "rule": "less_or_equal",
            "value": seconds,
        }
    )  # fmt: skip


def event(name: str, start: Fields, *actions: Fields) -> Fields:
    """Actions that begin when something holds."""
    return {
        "name": name, "start": start,
        "actions": [{"name": f"{name}_{a['kind']}", "action": a} for a in actions],
    }  # fmt: skip


def board(
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
    ego = {"name": "Ego", "kind": "ego", "box": EGO, "model": "ego"}
    return {"entities": [ego, *made], "init": init, "stories": stories}
