"""Storyboards of one car, and what became of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

START = {"kind": "lane", "road": "0", "lane": -1, "s": 100.0}


def condition(test: dict[str, Any], **options: Any) -> dict[str, Any]:
    return {"groups": [{"conditions": [{"test": test, **options}]}]}


def after(seconds: float, **options: Any) -> dict[str, Any]:
    test = {"kind": "simulation_time", "rule": "greater_or_equal", "value": seconds}
    return condition(test, **options)


def event(name: str, *actions: dict[str, Any], start: Any = None, **options: Any) -> dict[str, Any]:
    parts = [{"name": f"{name}_{k}", "action": a} for k, a in enumerate(actions)]
    return {"name": name, "actions": parts, "start": start, **options}


def action_at(seconds: float, action: dict[str, Any]) -> dict[str, Any]:
    return event(f"{action['kind']}_{seconds:g}", action, start=after(seconds))


def board(*events: Any, init: Any = (), car: Any = None, **options: Any) -> dict[str, Any]:
    """The car 100 m ahead of where the ego begins, as fast as it, with events of one maneuver."""
    begin = [
        ("car", {"kind": "teleport", "position": START}),
        ("car", {"kind": "speed", "speed": 10.0}),
        *init,
    ]
    group = {
        "name": "group", "entities": ["car"], "maneuvers": [{"name": "m", "events": list(events)}],
    }  # fmt: skip
    stories = [{"name": "story", "acts": [{"name": "act", "groups": [group]}]}] if events else []
    box = {"size": (4.6, 1.85, 1.5), "centre": (0.0, 0.0, 0.75)}
    return {
        "entities": [{"name": "Ego", "kind": "ego"}, {"name": "car", "box": box, **(car or {})}],
        "init": [{"entity": name, "action": action} for name, action in begin],
        "stories": stories,
        **options,
    }


def drive(world: Any, steps: int) -> list[Any]:
    """The world at each step, its ego as recorded."""
    worlds = [world.fork()]
    for _ in range(steps):
        world.step()
        worlds.append(world.fork())
    return worlds


def actor(world: Any, name: str = "car") -> Any:
    return world.storyboard.entities[name]


def speeds(worlds: list[Any], name: str = "car") -> np.ndarray:
    return np.array([actor(w, name).speed for w in worlds])


def places(worlds: list[Any], name: str = "car") -> np.ndarray:
    """x, y, heading at each step."""
    found = [actor(w, name) for w in worlds]
    return np.array([(a.x, a.y, math.remainder(a.h, math.tau)) for a in found])


def changes(worlds: list[Any]) -> list[tuple[float, str, str]]:
    """(seconds, name of the element, change) of all elements."""
    start = worlds[0].t_us
    return [
        ((e.t_us - start) * 1e-6, str(e.element).split("::")[-1], str(e.change))
        for w in worlds
        for e in w.observe().events
        if e.type == "storyboard"
    ]
