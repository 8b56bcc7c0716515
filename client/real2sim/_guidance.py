"""Calls that do not fit say what to write instead."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from real2sim_proto.guidance import Guided, advice

F = TypeVar("F", bound=Callable[..., Any])

KEYWORDS = {
    "acceleration": "plan=real2sim.Control(acceleration=1.0, steering=0.0)",
    "angle_deg": "angle=math.radians(15)",
    "camera_name": "camera='front'",
    "cameras": "sensors=['front']",
    "degrees": "angle=math.radians(15)",
    "dt": "dt_us=100_000 (microseconds)",
    "dx": "x=1.0 (metres)",
    "dy": "y=1.0 (metres)",
    "dz": "z=1.0 (metres)",
    "end": "end_us=2_000_000 (microseconds)",
    "height": "width=640; the height follows",
    "host": "url='http://127.0.0.1:8600'",
    "ip": "url='http://127.0.0.1:8600'",
    "max_steps": "steps=100",
    "n_steps": "steps=100",
    "options": "seed=0, horizon=50 and so on, each option by its name",
    "pos": "position=(x, y, z)",
    "port": "url='http://127.0.0.1:8600'",
    "rotation": "quaternion=(w, x, y, z)",
    "scene_name": "scene='street'",
    "start": "start_us=500_000 (microseconds)",
    "steering": "plan=real2sim.Control(acceleration=1.0, steering=0.0)",
    "time": "t=2.0 (seconds)",
    "time_us": "t_us=2_000_000 (microseconds)",
    "timestamp": "t_us=2_000_000 (microseconds)",
    "yaw": "angle=0.26 (radians)",
}
"""Arguments that people try first, and those that are meant."""


class Handle(Guided):
    """Base of the SDK's objects: wrong names and arguments say what to write instead."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name, value in list(vars(cls).items()):
            if inspect.isfunction(value) and (name == "__init__" or not name.startswith("_")):
                setattr(cls, name, guided(value))


def guided(function: F) -> F:
    """A function that, called with an unknown argument, says which one to write instead."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except TypeError as error:
            # Errors that come from inside the function have a traceback that goes on.
            if error.__traceback__ is None or error.__traceback__.tb_next is not None:
                raise
            taken = [p for p in inspect.signature(function).parameters if p != "self"]
            said = {argument_advice(name, taken): None for name in kwargs if name not in taken}
            said = said or {f"it takes {', '.join(taken) or 'nothing'}": None}
            raise TypeError(f"{error}; {'; '.join(said)}") from None

    return call  # type: ignore[return-value]


def argument_advice(name: str, taken: Sequence[str]) -> str:
    """What to write instead of an argument that is not among those that are taken."""
    meant = {k: v for k, v in KEYWORDS.items() if v.partition("=")[0] in taken}
    return advice(name, taken, meant, otherwise="it takes")
