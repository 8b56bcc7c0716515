"""Applying batches of operations to a state: pure and atomic, with their inverse and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.operations import Operation, subject_of
from real2sim_proto.scenarios import EditWarning

from ..geometry import box_corners, first_overlap, wrapped
from ..scene import Ground, SceneError, Trajectory
from . import lifecycle, motion
from .appearance import AWAY
from .motion import AppliedOperation, apply_operation
from .state import EditError, ObjectState, ScenarioState
from .tracks import Float, sample

# --- Validation ----------------------------------------------------------------------------------

SAMPLE_PERIOD_US = 100_000
MAX_SAMPLES = 201
MAX_GROUND_SAMPLES = 21
OFF_GROUND = 0.3
"""A box bottom this much higher or lower above ground than in the recording is reported [m]."""

OUTSIDE_MAP = 100.0
"""An object this far outside the bounding rectangle of the recording is reported [m]."""

SLIP, SLIP_STEPS, MOVING = np.radians(20), 5, 1.0
"""An object is reported if its motion deviates by more than this angle from its heading [rad] for
this many samples more than in the recording. Slower objects [m/s] count as stationary.
"""

MIN_SEEN = 0.6
"""Surfaces of which images saw a smaller share get a warning."""

TURNED = np.radians(30)
"""An object turned by more than this against the recorded drive shows other sides [rad]."""

NAMED_OVERLAPS = 5

REMEMBERED_RANGES = 4
"""Number of cached time ranges of samples per trajectory, at most 26 kB each."""
REMEMBERED = 512

_Samples = tuple[Float, NDArray[np.bool_]]
_samples: WeakKeyDictionary[Trajectory, dict[tuple[int, int], _Samples]] = WeakKeyDictionary()


def validate_edit(state: ScenarioState, touched: Sequence[str]) -> Iterator[EditWarning]:
    """Warnings about the objects ``touched``, checked every 0.1 s of their trajectories.

    Very long trajectories are checked at 201 evenly spread times.

    Args:
        state: state after the edit.
        touched: ids that the edit named or created; of deleted ones, only the ground is checked.
    """
    for subject in (state.objects[i] for i in touched):
        yield from _uncovered_ground(subject, state)
        if subject.deleted:
            continue
        times = _sample_times(subject.trajectory.start_us, subject.trajectory.end_us)
        transforms, _ = _sampled(subject.trajectory, int(times[0]), int(times[-1]))
        yield from _overlaps(subject, state, times, transforms)
        recorded = None if subject.asset else state.recorded[subject.source_id]
        yield from _off_ground(subject, recorded, transforms, state.ground)
        yield from _outside_map(subject, state.extent, transforms)
        yield from _sideways(subject, recorded, times, transforms)
        yield from _unseen_sides(subject, recorded, state, times, transforms)


def _sampled(trajectory: Trajectory, start_us: int, end_us: int) -> _Samples:
    """The trajectory at the sample times of that range, cached for the trajectory's lifetime.

    A cache of fixed size would miss every lookup once a scenario has more objects than entries.
    """
    by_range = _samples.setdefault(trajectory, {})
    found = by_range.get((start_us, end_us))
    if found is None:
        while len(by_range) >= REMEMBERED_RANGES:
            # Scenarios share trajectories and may be edited on several threads.
            by_range.pop(next(iter(by_range), (0, 0)), None)
        found = by_range[start_us, end_us] = sample(trajectory, _sample_times(start_us, end_us))
    return found


@lru_cache(maxsize=REMEMBERED)
def _sample_times(start: int, end: int) -> NDArray[np.int64]:
    count = min(2 + (end - start) // SAMPLE_PERIOD_US, MAX_SAMPLES)
    steps = np.arange(count, dtype=object) * (end - start) // (count - 1)
    times = np.unique((start + steps).astype(np.int64))
    times.flags.writeable = False
    return times


def _overlaps(
    subject: ObjectState, state: ScenarioState, times: NDArray[np.int64], own: Float
) -> Iterator[EditWarning]:
    hit = {}
    for other in _within_reach(subject, state, own):
        first = _first_overlap(subject, other, times, own)
        if first < len(times):
            hit[other.object_id] = times[first] * 1e-6
    if hit:
        named = [f"{i!r} from t={t:.2f} s" for i, t in list(hit.items())[:NAMED_OVERLAPS]]
        more = f" and {len(hit) - len(named)} more" if len(hit) > len(named) else ""
        yield EditWarning(
            code="overlap",
            object_id=subject.object_id,
            message=f"{subject.object_id!r} overlaps {', '.join(named)}{more}",
        )


def _first_overlap(
    subject: ObjectState, other: ObjectState, times: NDArray[np.int64], own: Float
) -> int:
    """Index of the first time at which the boxes overlap; ``len(times)`` if they never do."""
    theirs, covered = _sampled(other.trajectory, int(times[0]), int(times[-1]))
    found: int = first_overlap(
        (own, theirs),
        (subject.scaled_size, other.scaled_size),
        covered,
        subject.radius + other.radius,
        subject.standing and other.standing,
    )
    return found


def _within_reach(subject: ObjectState, state: ScenarioState, own: Float) -> Iterator[ObjectState]:
    """Visible objects whose path's bounding box is close to that of ``subject``."""
    others = [o for o in state.objects.values() if not o.deleted and o is not subject]
    if not others:
        return
    bounds = np.array([o.bounds for o in others])
    at, radius = own[:, :3, 3], subject.radius
    low, high = at.min(axis=0) - radius, at.max(axis=0) + radius
    apart = (bounds[:, 0] > high) | (bounds[:, 1] < low)
    for i in np.flatnonzero(~apart.any(axis=1)):
        yield others[i]


def _off_ground(
    subject: ObjectState, recorded: ObjectState | None, own: Float, ground: Ground
) -> Iterator[EditWarning]:
    usual = 0.0
    if recorded is not None:
        usual = _recorded_clearance(recorded, ground)
    off = _clearance(own, subject, ground) - usual
    worst = float(off[np.argmax(np.abs(off))])
    if abs(worst) > OFF_GROUND:
        side = "above" if worst > 0 else "below"
        yield EditWarning(
            code="off_ground",
            object_id=subject.object_id,
            message=f"the bottom of {subject.object_id!r} is {abs(worst):.2f} m {side} "
            + ("where it stood in the recording" if recorded else "the ground"),
        )


@lru_cache(maxsize=REMEMBERED)
def _recorded_clearance(recorded: ObjectState, ground: Ground) -> float:
    track = recorded.trajectory
    theirs, _ = _sampled(track, track.start_us, track.end_us)
    return float(np.median(_clearance(theirs, recorded, ground)))


def _clearance(transforms: Float, subject: ObjectState, ground: Ground) -> Float:
    sparse = _sparse(transforms, 1 if subject.standing else MAX_GROUND_SAMPLES)
    lowest: Float = box_corners(sparse, subject.scaled_size)[..., 2].min(axis=-1)
    return lowest - ground.height_at(sparse[:, :2, 3])


def _sparse(transforms: Float, count: int) -> Float:
    return transforms[:: -(-len(transforms) // count)]


def _outside_map(subject: ObjectState, extent: Float, transforms: Float) -> Iterator[EditWarning]:
    at = transforms[:, :2, 3]
    beyond = np.maximum(np.maximum(extent[0] - at, at - extent[1]), 0.0)
    farthest = float(np.linalg.norm(beyond, axis=1).max())
    if farthest > OUTSIDE_MAP:
        yield EditWarning(
            code="outside_map",
            object_id=subject.object_id,
            message=f"{subject.object_id!r} gets {farthest:.0f} m away from everything recorded",
        )


def _sideways(
    subject: ObjectState, recorded: ObjectState | None, times: NDArray[np.int64], own: Float
) -> Iterator[EditWarning]:
    if not subject.edited or subject.standing:
        return
    slips = _slips(times, own)
    usual = 0
    if recorded is not None:
        track = recorded.trajectory
        theirs, _ = _sampled(track, track.start_us, track.end_us)
        usual = int((_slips(_sample_times(track.start_us, track.end_us), theirs) > SLIP).sum())
    if (slips > SLIP).sum() >= usual + SLIP_STEPS:
        yield EditWarning(
            code="sideways",
            object_id=subject.object_id,
            message=f"{subject.object_id!r} goes sideways, up to {np.degrees(slips.max()):.0f} "
            "degrees off its heading; a rotation with about_us turns its path with it",
        )


def _slips(times: NDArray[np.int64], transforms: Float) -> Float:
    """Angle [T - 1] between motion and heading, forwards or backwards [rad]; 0 at standstill."""
    way = np.diff(transforms[:, :2, 3], axis=0)
    length = np.linalg.norm(way, axis=1)
    ahead = transforms[:-1, :2, 0] + transforms[1:, :2, 0]
    along = np.abs((way * ahead).sum(axis=1))
    across = np.abs(way[:, 0] * ahead[:, 1] - way[:, 1] * ahead[:, 0])
    slips: Float = np.where(length > MOVING * np.diff(times) * 1e-6, np.arctan2(across, along), 0.0)
    return slips


def _unseen_sides(
    subject: ObjectState,
    recorded: ObjectState | None,
    state: ScenarioState,
    times: NDArray[np.int64],
    own: Float,
) -> Iterator[EditWarning]:
    coverage = state.coverage
    if coverage is None or recorded is None or not subject.edited:
        return
    if subject.category in lifecycle.PEOPLE:
        return
    track = recorded.trajectory
    theirs, _ = _sampled(track, track.start_us, track.end_us)
    usual = _drive_seen_from(recorded, theirs, track.start_us, track.end_us, coverage.ego)
    azimuth = _drive_seen_from(subject, own, int(times[0]), int(times[-1]), coverage.ego)
    if usual is None or azimuth is None or abs(wrapped(azimuth - usual)) <= TURNED:
        return
    share = coverage.of_side(subject.source_id, azimuth)
    if share < MIN_SEEN:
        yield EditWarning(
            code="unseen_sides",
            object_id=subject.object_id,
            message=f"{100 * share:.0f} % of the sides of {subject.object_id!r} that face the "
            "recorded drive were ever seen; the colours of the rest are guessed. Turn its recorded "
            "side to the drive, or replace it with an asset",
        )


def _drive_seen_from(
    subject: ObjectState, transforms: Float, start_us: int, end_us: int, ego: Trajectory
) -> float | None:
    """Azimuth [rad], in the object's frame, of the recording vehicle where it is nearest.

    A standing object is compared with the whole drive, a moving one at the same times; None if they
    have none in common.
    """
    if subject.standing:
        transforms, there = transforms[:1], ego.positions
    else:
        vehicle, covered = _sampled(ego, start_us, end_us)
        transforms, there = transforms[covered], vehicle[covered, :3, 3]
    if not len(there):
        return None
    ways = there[:, :2] - transforms[:, :2, 3]
    nearest = int(np.linalg.norm(ways, axis=1).argmin())
    pose = transforms[min(nearest, len(transforms) - 1)]
    # Scaling an axis turns its normals the other way.
    x, y = ways[nearest] @ pose[:2, :2] / subject.scale[:2]
    return float(np.arctan2(y, x))


def _uncovered_ground(subject: ObjectState, state: ScenarioState) -> Iterator[EditWarning]:
    coverage, recorded = state.coverage, state.recorded.get(subject.object_id)
    if coverage is None or recorded is None or recorded.category in lifecycle.PEOPLE:
        return
    track = recorded.trajectory
    theirs, _ = _sampled(track, track.start_us, track.end_us)
    if not subject.deleted:
        own, covered = _sampled(subject.trajectory, track.start_us, track.end_us)
        apart = np.linalg.norm(own[:, :2, 3] - theirs[:, :2, 3], axis=1)
        if (covered & (apart <= AWAY)).all():
            return
    footprints = [theirs[0]]
    for pose in _sparse(theirs, MAX_GROUND_SAMPLES):
        if np.linalg.norm(pose[:2, 3] - footprints[-1][:2, 3]) > AWAY:
            footprints.append(pose)
    share = coverage.of_ground(subject.object_id, footprints, recorded.size)
    if share < MIN_SEEN:
        yield EditWarning(
            code="unseen_ground",
            object_id=subject.object_id,
            message=f"{100 * share:.0f} % of the ground that {subject.object_id!r} leaves was ever "
            "seen; the colours of the rest are guessed. Put another object there, or keep cameras "
            "away from it",
        )


OPERATION_MODULES = (lifecycle, motion)
"""Importing them registers their operations, see :mod:`.motion`."""

MAX_OBJECTS = 4096
"""Maximum number of objects in a scenario, without deleted ones; streets have some hundreds."""


@dataclass(frozen=True, eq=False)
class EditOutcome:
    """Result of a batch of operations.

    Attributes:
        state: state after all operations.
        created: ids of new objects, regions and colliders, in order.
        inverse: operations that revert the batch when applied in this order. Numbers are restored
            up to rounding; `Scenario.undo` restores the exact state.
        warnings: for review by a person.
    """

    state: ScenarioState
    created: tuple[str, ...]
    inverse: tuple[Operation, ...]
    warnings: tuple[EditWarning, ...]


def apply_operations(state: ScenarioState, operations: Sequence[Operation]) -> EditOutcome:
    """Apply all of ``operations`` in order, or none of them.

    Args:
        state: not changed.
        operations: validated wire models.

    Raises:
        EditError: UNKNOWN_OBJECT, UNKNOWN_ASSET or INVALID_OPERATION, with the index in the batch;
            also for more than MAX_OBJECTS objects.
    """
    changes: list[AppliedOperation] = []
    after = state
    for index, operation in enumerate(operations):
        change = _apply_one(after, operation, index)
        after = change.state
        if change.created is not None:
            _check_number(after, operation, index)
        changes.append(change)
    touched = dict.fromkeys(c.touched for c in changes if c.touched is not None)
    return EditOutcome(
        state=after,
        created=tuple(c.created for c in changes if c.created is not None),
        inverse=tuple(c.inverse for c in reversed(changes)),
        warnings=tuple(validate_edit(after, tuple(touched))),
    )


def replay_operations(state: ScenarioState, operations: Sequence[Operation]) -> ScenarioState:
    """Only the state of :func:`apply_operations`, for replaying a log; raises the same errors."""
    for index, operation in enumerate(operations):
        state = _apply_one(state, operation, index).state
    return state


def _apply_one(state: ScenarioState, operation: Operation, index: int) -> AppliedOperation:
    try:
        return apply_operation(state, operation)
    except EditError as error:
        where = f"operation {index} ({_named(operation)}): {error}"
        raise EditError(error.code, where, hint=error.hint, index=index) from None
    except SceneError as error:
        where = f"operation {index} ({_named(operation)}): {error}"
        raise EditError(ErrorCode.INVALID_OPERATION, where, index=index) from error


def _check_number(state: ScenarioState, operation: Operation, index: int) -> None:
    """Check the limit for new edits; existing logs beyond the limit are still replayed."""
    if len(state.objects) <= MAX_OBJECTS:
        return
    if sum(not found.deleted for found in state.objects.values()) > MAX_OBJECTS:
        raise EditError(
            ErrorCode.INVALID_OPERATION,
            f"operation {index}: a scenario has {MAX_OBJECTS} objects at most",
            hint="delete objects that are not needed",
            index=index,
        )


def _named(operation: Operation) -> str:
    subject = subject_of(operation)
    return f"{operation.op} of {subject!r}" if subject is not None else operation.op
