"""What the seed of an episode draws: its start, traffic parameters, ego estimate, latency.

Every value has a name, such as ``start.lateral`` or ``agents.car_3.headway``, under which it is
drawn (see :mod:`.draws`) and reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from real2sim_proto.episode import (
    EstimateRandomization,
    IdmDriver,
    StartRandomization,
    TrafficRandomization,
)

from ..edit import ObjectState
from .common import Draws
from .ego.motion import Motion
from .path import LoggedPath, PathPoint
from .traffic.idm import desired_speed

START_ATTEMPTS = 16
"""Starts drawn before the recorded one is taken, where all of them are inside an object."""


def randomized_start(
    recorded: Motion,
    path: LoggedPath,
    spec: StartRandomization,
    draws: Draws,
    *,
    is_free: Callable[[Motion], bool],
) -> tuple[Motion, dict[str, float]]:
    """The motion at the start of an episode, and what was drawn for it by name.

    Args:
        recorded: the ego in the log at that time.
        path: the recorded drive.
        spec: ranges.
        draws: of the episode.
        is_free: whether a motion touches no object.
    """
    widths = {f"start.{name}": width for name, width in spec.model_dump().items() if width}
    if not widths:
        return recorded, {}
    near = path.nearest(recorded.x, recorded.y)
    for attempt in range(START_ATTEMPTS):
        drawn = {name: draws.around(width, name, attempt) for name, width in widths.items()}
        motion = _shifted(recorded, path, near, drawn)
        if is_free(motion):
            drawn["start.speed"] = motion.speed - recorded.speed
            return motion, {name: drawn[name] for name in widths}
    return recorded, dict.fromkeys(widths, 0.0)


def _shifted(
    recorded: Motion, path: LoggedPath, near: PathPoint, drawn: Mapping[str, float]
) -> Motion:
    x, y, _, yaw = path.at(near.s + drawn.get("start.longitudinal", 0.0))
    offset = near.offset + drawn.get("start.lateral", 0.0)
    speed = max(recorded.speed + drawn.get("start.speed", 0.0), 0.0)
    turns = speed / recorded.speed if recorded.speed > 0 else 0.0
    return recorded._replace(
        x=x - offset * math.sin(yaw),
        y=y + offset * math.cos(yaw),
        yaw=yaw + (recorded.yaw - near.yaw) + drawn.get("start.heading", 0.0),
        speed=speed,
        yaw_rate=recorded.yaw_rate * turns,
    )


@dataclass(frozen=True)
class RandomizedIdm:
    """Parameters of IDM drivers as the seed draws them for each object.

    Attributes:
        spec: widths of the factors.
        draws: of the episode.
    """

    spec: TrafficRandomization
    draws: Draws
    widths: Mapping[str, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        widths = {name: width for name, width in self.spec.model_dump().items() if width}
        object.__setattr__(self, "widths", widths)

    def driver_of(
        self, subject: ObjectState, spec: IdmDriver
    ) -> tuple[IdmDriver, dict[str, float]]:
        """The parameters of an object's driver, and those that were drawn by name."""
        drawn: dict[str, float] = {}
        for name, width in self.widths.items():
            value = getattr(spec, name)
            if name == "desired_speed":
                value = desired_speed(subject, spec)
            key = f"agents.{subject.object_id}.{name}"
            drawn[key] = value * (1.0 + self.draws.around(width, key))
        named = {key.rpartition(".")[2]: value for key, value in drawn.items()}
        return spec.model_copy(update=named), drawn


class EstimateError(NamedTuple):
    """How the ego's estimate of itself differs from the truth: [m], [m], [rad], [m/s]."""

    x: float
    y: float
    yaw: float
    speed: float

    def applied(self, motion: Motion) -> Motion:
        """The estimate of a motion."""
        return motion._replace(
            x=motion.x + self.x,
            y=motion.y + self.y,
            yaw=motion.yaw + self.yaw,
            speed=motion.speed + self.speed,
        )


def estimate_error(
    spec: EstimateRandomization,
    draws: Draws,
    step: int,
    *,
    before: EstimateError | None = None,
    dt: float = 0.0,
) -> EstimateError | None:
    """The error at a step; None where the estimate is the truth.

    Args:
        spec: standard deviations.
        draws: of the episode.
        step: of the clock.
        before: the error one step earlier.
        dt: clock step [s].
    """
    deviations = (spec.position, spec.position, spec.heading, spec.speed)
    if not any(deviations):
        return None
    fresh = draws.normal("estimate", step, count=4)
    if before is None or not spec.correlation:
        return EstimateError(*(d * n for d, n in zip(deviations, fresh, strict=True)))
    kept = math.exp(-dt / spec.correlation)
    new = math.sqrt(1.0 - kept * kept)
    pairs = zip(before, deviations, fresh, strict=True)
    return EstimateError(*(kept * b + new * d * n for b, d, n in pairs))


def latency_jitter_us(longest_us: int, draws: Draws, step: int) -> int:
    """The wait that is added to the latency of the plan for a step [us]; 0 where none is drawn."""
    return int(draws.uniform("latency", step)[0] * (longest_us + 1)) if longest_us else 0
