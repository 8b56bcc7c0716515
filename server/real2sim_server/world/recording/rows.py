"""Parts of a recording as plain values, and back; everything is checked where it comes in.

Kernels that score look at no index twice, so shapes, lengths and values must be right before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from ...geometry.rotation import Float
from ..ego.plan import PlannedTrajectory
from ..path import LoopTransform
from ..scoring import ContactRecord, EgoSample, Instant, ObjectSamples, ScoringContext
from ..scoring.instant import Side
from ..storyboard.program import ShownSignal

MAX_WAY_M = 1e6
"""Length of a route or lane [m]: they are cut into pieces of less than a metre."""

MAX_NUMBER = 1e12
"""Of any length, speed or mass in SI units."""


def instant_row(instant: Instant, digest: str) -> dict[str, Any]:
    """An instant and the digest of its observation as plain values."""
    others = instant.others
    row: dict[str, Any] = {
        "step": instant.step,
        "t_us": instant.t_us,
        "ego": list(instant.ego),
        "ids": list(others.ids),
        "categories": list(others.categories),
        "centres": others.centres,
        "yaws": others.yaws,
        "sizes": others.sizes,
        "velocities": others.velocities,
        "contacts": [asdict(c) | {"impulse": list(c.impulse)} for c in instant.contacts],
        "secondary": instant.secondary,
        "digest": digest,
    }
    if instant.plan is not None:
        row["plan"] = [instant.plan.times_us.tolist(), instant.plan.poses.tolist()]
    if instant.seam is not None:
        row["seam"] = list(instant.seam)
    if instant.signals:
        row["signals"] = [[s.signal_id, s.state, s.stop_line] for s in instant.signals]
    return row


def read_instant(row: Mapping[str, Any]) -> tuple[Instant, str]:
    """Inverse of :func:`instant_row`.

    Raises:
        ValueError, KeyError, TypeError: it is none.
    """
    ids = tuple(_text(name) for name in _list(row["ids"]))
    count = len(ids)
    categories = tuple(_text(name) for name in _list(row["categories"]))
    if len(categories) != count:
        raise ValueError(f"{len(categories)} categories of {count} objects")
    instant = Instant(
        step=_integer(row["step"]),
        t_us=_integer(row["t_us"]),
        ego=EgoSample(*_numbers(row["ego"], (len(EgoSample._fields),), "ego").tolist()),
        others=ObjectSamples(
            ids=ids,
            categories=categories,
            centres=_numbers(row["centres"], (count, 3), "centres"),
            yaws=_numbers(row["yaws"], (count,), "yaws"),
            sizes=_numbers(row["sizes"], (count, 3), "sizes"),
            velocities=_numbers(row["velocities"], (count, 2), "velocities"),
        ),
        contacts=tuple(_contact(c) for c in _list(row["contacts"])),
        secondary=_integer(row["secondary"]),
        plan=_plan(row["plan"]) if "plan" in row else None,
        seam=LoopTransform(*_numbers(row["seam"], (3,), "seam").tolist())
        if "seam" in row
        else None,
        signals=tuple(_signal(s) for s in _list(row.get("signals", []))),
    )
    return instant, _text(row["digest"])


def read_context(fields: Mapping[str, Any]) -> ScoringContext:
    """The context that :meth:`ScoringContext.fields` gave.

    Raises:
        ValueError, KeyError, TypeError: it gave none like that.
    """
    for name in ("dt", "rear_overhang", "ego_mass", "corridor", "lane", "start_s", "route_end_s"):
        _number(fields[name], name)
    for name in ("speed_limit", "no_action_impact"):
        if fields.get(name) is not None:
            _number(fields[name], name)
    if _integer(fields.get("warmup_steps", 0)) < 0:
        raise ValueError(f"{fields['warmup_steps']} steps of warm-up")
    for name in ("background", "reactive"):
        if not isinstance(fields.get(name, False), bool):
            raise ValueError(f"{name} is {str(fields[name])[:40]!r}, neither true nor false")
    expert = _numbers(fields["expert_s"], (None,), "expert_s")
    if _integer(fields["horizon"]) + 1 != len(expert) or fields["dt"] <= 0:
        raise ValueError(f"horizon {fields['horizon']} does not fit {len(expert)} expert positions")
    if fields["ego_mass"] <= 0:
        raise ValueError(f"an ego_mass of {fields['ego_mass']} kg; it is above 0")
    _numbers(fields["ego_size"], (3,), "ego_size")
    _numbers([list(pair) for pair in fields["history"]] or np.zeros((0, 2)), (None, 2), "history")
    route = _way(fields["route"], "route")
    if len(route) < 2 or (route[0] == route[1]).all() or (route[-1] == route[-2]).all():
        raise ValueError("the route has no direction at an end")
    lanes = [_way(line, "lane") for line in _list(fields["lanes"])]
    return ScoringContext.from_fields(dict(fields) | {"route": route, "lanes": lanes})


def _way(value: Any, what: str) -> Float:
    points = _numbers(value, (None, 2), what)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    if length > MAX_WAY_M:
        raise ValueError(f"a {what} of {length:.0f} m; allowed are {MAX_WAY_M:.0f} m")
    return points


def _contact(fields: Mapping[str, Any]) -> ContactRecord:
    x, y = _numbers(fields["impulse"], (2,), "impulse").tolist()
    for name in ("relative_speed", "ego_speed", "object_speed"):
        _number(fields[name], name)
    _number(fields.get("since", 1.0), "since")
    if fields["object_id"] is not None:
        _text(fields["object_id"])
    if fields["side"] not in get_args(Side) or not isinstance(fields["begun"], bool):
        raise ValueError(f"a contact on side {fields['side']!r}")
    _text(fields["category"])
    return ContactRecord(**dict(fields) | {"impulse": (x, y)})


def _signal(value: Any) -> ShownSignal:
    name, state, line = _list(value)
    if line is None:
        return ShownSignal(_text(name), _text(state), None)
    x, y, heading = _numbers(line, (3,), "stop line").tolist()
    return ShownSignal(_text(name), _text(state), (x, y, heading))


def _plan(value: Any) -> PlannedTrajectory:
    times, poses = value
    whole = np.array([_integer(t) for t in _list(times)], np.int64)
    if not len(whole) or (np.diff(whole) <= 0).any():
        raise ValueError("the times of a plan do not increase")
    return PlannedTrajectory(whole, _numbers(poses, (len(whole), 3), "plan"))


def _numbers(value: Any, shape: tuple[int | None, ...], what: str) -> Float:
    """Float64 of a shape; None goes for any length. A copy: kernels are compiled anew for arrays
    that must not be written to."""
    array: NDArray[np.float64] = np.array(value, dtype=np.float64)
    fits = len(shape) == array.ndim and all(
        wanted in (None, given) for wanted, given in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{what} has shape {list(array.shape)}, not {list(shape)}")
    if not (np.abs(array) <= MAX_NUMBER).all():
        raise ValueError(f"{what} holds values that are not finite, or beyond {MAX_NUMBER:g}")
    return array


def _number(value: Any, what: str) -> None:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and abs(value) <= MAX_NUMBER):
        raise ValueError(f"{what} is {str(value)[:40]!r}, no number within {MAX_NUMBER:g}")


def _integer(value: Any) -> int:
    if type(value) is not int or abs(value) > 1 << 62:
        raise ValueError(f"{value!r} is no whole number of 63 bits")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"a {type(value).__name__} where text must be")
    return value


def _list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"a {type(value).__name__} where a list must be")
    return value
