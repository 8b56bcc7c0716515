"""Drives along a straight street, calculated by hand, and their scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from real2sim_server.world import scoring
from real2sim_server.world.scoring import EgoSample, Instant, ObjectSamples, ScoringContext

DT = 0.1
NOBODY = ObjectSamples((), (), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 2)))


def context(steps: int, **changes) -> ScoringContext:
    """A straight street along x; the recorded drive has 10 m/s."""
    made = ScoringContext(
        dt=DT,
        horizon=steps,
        ego_size=(4.6, 1.85, 1.6),
        rear_overhang=0.95,
        ego_mass=1500.0,
        route=np.stack([np.arange(0.0, 201.0), np.zeros(201)], axis=1),
        lanes=(),
        corridor=3.5,
        lane=1.75,
        speed_limit=None,
        start_s=0.0,
        route_end_s=10.0 * DT * steps,
        expert_s=tuple(10.0 * DT * k for k in range(steps + 1)),
        history=(),
    )
    return replace(made, **changes)


def ego(x: float, y: float = 0.0, *, speed: float = 10.0, yaw: float = 0.0) -> EgoSample:
    return EgoSample(x, y, yaw, speed, 0.0, 0.0, 0.0, 0.0, x, y, 0.0, 0.0)


def car(x: float, y: float = 0.0, *, speed: float = 0.0, category: str = "car") -> ObjectSamples:
    return ObjectSamples(
        ("car",),
        (category,),
        np.array([[x, y, 0.8]]),
        np.zeros(1),
        np.array([[4.0, 2.0, 1.6]]),
        np.array([[speed, 0.0]]),
    )


def drive(speeds: list[float], *, y: float = 0.0, others=None) -> list[Instant]:
    """Instants of a drive along x at lateral offset y; ``others(step)`` gives the other objects."""
    x, instants = 0.0, []
    for k, speed in enumerate(speeds):
        x += speed * DT if k else 0.0
        who = others(k) if others else NOBODY
        instants.append(Instant(k, k * 100_000, ego(x, y, speed=speed), who))
    return instants


def scores(instants: list[Instant], given: ScoringContext) -> dict[str, scoring.Score]:
    accumulator = scoring.begin_accumulator(instants[0], given)
    for instant in instants[1:]:
        accumulator = scoring.update_accumulator(accumulator, instant, given)
    return {s.name: s for s in scoring.scores_of(accumulator, given)}
