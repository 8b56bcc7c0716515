"""Which parts of simulated vehicles broke, found in the frames of a rollout."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ..geometry.rotation import Float
from ..geometry.transform import apply_transform
from .damage import Breakage, BreakageLog
from .damage.parts import Part
from .playback import PlacedObject
from .result import ObjectResult, SimulationResult

LEAVING_TIME = 0.04
"""After a part has broken its fragments are free [s]."""


def find_breakages(
    result: SimulationResult, subjects: Iterable[PlacedObject]
) -> tuple[Breakage, ...]:
    """All parts that broke, in the order of objects and time."""
    there = {s.object_id: s for s in subjects}
    found: list[Breakage] = []
    for object_id, own in result.objects.items():
        subject = there[object_id]
        log = BreakageLog(
            subject.category,
            subject.scaled_size,
            own.rest.astype(np.float64),
            spacing=own.spacing,
        )
        broken: list[tuple[Part, int]] = []
        last = -1
        for frame, row in enumerate(own.shape_index.tolist()):
            if row not in (-1, last):
                last = row
                new = log.follow(own.shapes[row].astype(np.float64))
                broken += [(part, frame) for part in new]
        found += [_breakage(result, own, log, part, frame) for part, frame in broken]
    return tuple(found)


def _breakage(
    result: SimulationResult, own: ObjectResult, log: BreakageLog, part: Part, frame: int
) -> Breakage:
    # Fragments leave with what is left of the velocity when all has given way there.
    after = int(np.searchsorted(result.times_s, result.times_s[frame] + LEAVING_TIME))
    after = min(max(after, frame + 1), result.frames - 1)
    before = max(after - 1, 0)
    places = {f: _place(own, log, part, f) for f in (before, frame, after)}
    elapsed = float(result.times_s[after] - result.times_s[before])
    velocity = (places[after] - places[before]) / max(elapsed, 1e-9)
    outward = own.transform(frame)[:3, :3] @ np.array(part.outward)
    return Breakage(
        own.object_id,
        part.name,
        part.kind,
        float(result.times_s[frame]),
        _triple(places[frame]),
        _triple(velocity),
        _triple(outward),
        log.broken[part.name],
    )


def _place(own: ObjectResult, log: BreakageLog, part: Part, frame: int) -> Float:
    moved = own.displacements(frame)
    still = np.zeros_like(own.rest) if moved is None else moved
    local = log.place(part, still.astype(np.float64))
    placed: Float = apply_transform(own.transform(frame), local[None])[0]
    return placed


def _triple(vector: Float) -> tuple[float, float, float]:
    x, y, z = np.round(vector, 6).tolist()
    return x, y, z
