"""Beyond the end of the log: the route goes on, and what stood in the recording goes on standing.

The clock of an episode may outlast the recording (``beyond_log`` of its reset). The route then goes
on with the bend that the recorded drive ended with, which fades into a straight line. With ``loop``
the ego that has reached the end of the recorded drive is put back to its start, at the same place
beside the route and with the same error of heading: a :class:`.seam.Seam`. Everything else stays
where it is, but road users that drive along the route come along.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import ResetSpec

from ..edit import ObjectState, ScenarioState
from ..edit.tracks import PackedTracks
from ..geometry.box_kernels import boxes_overlap
from ..scene import Ground, Scene, Trajectory
from .common import WorldError
from .ego.motion import Motion
from .path import Float, LoggedPath, PathPoint
from .traffic.idm import highest_speed

BEND_FROM = 10.0
"""The bend at the end of the recorded drive is that of its last metres [m]."""

SHARPEST_BEND = 0.05
"""More than this is noise or a turn at a junction, which the road does not go on with [1/m]."""

BEND_FADES = 40.0
"""Way along which a bend falls to 1/e [m]."""

SPACING, FADED = 2.0, 160.0
"""Of the places behind the recorded drive, and where the rest of the way is straight [m]."""

LONGEST_ROUTE = 100_000.0
"""[m]"""

FASTEST = 15.0
"""A route is long enough to go on at this speed, or half as fast again as recorded [m/s]."""

SHORTEST_LOOP = 20.0
"""Recorded drives shorter than this are no loop [m]."""

STANDING = 2.0
"""Objects that cover less than this in the recording stand [m]."""


def driven_route(scene: Scene, spec: ResetSpec, horizon: int) -> LoggedPath:
    """The way that an episode is measured along: the recorded drive and, where the episode may go
    beyond it, its continuation.

    Raises:
        WorldError: INVALID_REQUEST for a loop on a recorded drive that is none.
    """
    recorded = LoggedPath(scene.ego)
    if spec.beyond_log == "end":
        return recorded
    spawn = spec.agents.spawn
    if spec.beyond_log == "loop" and recorded.length < SHORTEST_LOOP:
        raise WorldError(
            ErrorCode.INVALID_REQUEST,
            f"the recorded drive is {recorded.length:.1f} m long, too short to be driven in a loop",
            hint=f"a loop takes {SHORTEST_LOOP:g} m; choose beyond_log 'extend'",
        )
    reach = max(FADED, spawn.ahead + spawn.margin if spawn is not None else 0.0)
    if spec.beyond_log == "extend":
        speed = max(1.5 * highest_speed(scene.ego), FASTEST)
        reach = min(max(horizon * spec.dt_us * 1e-6 * speed, reach), LONGEST_ROUTE)
    return continued(recorded, reach, scene.ground)


def lanes_route(route: LoggedPath, scene: Scene, spec: ResetSpec) -> LoggedPath:
    """The way that lanes of spawned objects run beside; it goes on where the episode's may end."""
    spawn = spec.agents.spawn
    if spawn is None or spec.beyond_log != "end":
        return route
    return continued(route, max(FADED, spawn.ahead + spawn.margin), scene.ground)


def continued(path: LoggedPath, reach: float, ground: Ground) -> LoggedPath:
    """The path and ``reach`` more metres of it, on the ground."""
    before = path.at(max(path.length - BEND_FROM, 0.0))[3]
    bend = (float(path.yaws[-1]) - before) / min(BEND_FROM, path.length)
    bend = min(max(bend, -SHARPEST_BEND), SHARPEST_BEND)
    way = SPACING * np.arange(1, round(min(reach, FADED) / SPACING) + 1)
    yaws = path.yaws[-1] + bend * BEND_FADES * (1.0 - np.exp(-way / BEND_FADES))
    # Along the chord of each piece, whose heading is that of its middle.
    middles = np.concatenate([[path.yaws[-1]], yaws])
    chords = SPACING * np.exp(0.5j * (middles[1:] + middles[:-1]))
    plane = path.positions[-1, 0] + 1j * path.positions[-1, 1] + np.cumsum(chords)
    if reach > FADED:
        plane = np.append(plane, plane[-1] + (reach - FADED) * np.exp(1j * yaws[-1]))
        yaws = np.append(yaws, yaws[-1])
    xy = np.stack([plane.real, plane.imag], axis=1)
    x, y, z = path.positions[-1].tolist()
    above = z - ground.height(x, y)
    places = np.column_stack([xy, ground.height_at(xy) + above])
    return LoggedPath.through(
        np.vstack([path.positions, places]),
        np.concatenate([path.yaws, yaws]),
        np.vstack([path.ups, np.tile([0.0, 0.0, 1.0], (len(places), 1))]),
    )


def at_start_again(motion: Motion, near: PathPoint, route: LoggedPath, s: float) -> Motion:
    """The motion at distance ``s`` of the route, beside it and turned against it as it is at
    ``near``."""
    x, y, _, yaw = route.at(s)
    return motion._replace(
        x=x - near.offset * math.sin(yaw),
        y=y + near.offset * math.cos(yaw),
        yaw=yaw + math.remainder(motion.yaw - near.yaw, math.tau),
    )


# --- objects --------------------------------------------------------------------------------------

Prolonged = dict[Trajectory, Trajectory]
"""Trajectories of standing objects by what they were before they were prolonged, so that one is
the same object as long as an episode lasts: drivers begin anew with another."""


def tracks_beyond_log(
    state: ScenarioState, until_us: int, prolonged: Prolonged, *, left: Iterable[str] = ()
) -> PackedTracks[ObjectState]:
    """Where the objects are, up to ``until_us`` [us]: what stands is there all the time.

    Of standing objects whose boxes overlap, such as two tracks of one parked car, only the one
    that was recorded longest is there longer than it was recorded.

    Args:
        state: objects after all edits.
        until_us: end of the episode [us].
        prolonged: of the episode; it is added to.
        left: ids of those that have left.
    """
    gone = frozenset(left)
    visible = [o for o in state.visible if o.object_id not in gone]
    kept = _without_doubles([o for o in visible if o.trajectory.extent < STANDING])
    for subject in visible:
        if subject.object_id in kept and subject.trajectory not in prolonged:
            span = (_from_us(subject, state.clock[0]), until_us)
            prolonged.setdefault(subject.trajectory, _prolonged(subject.trajectory, *span))
    return PackedTracks(
        tuple(
            replace(o, trajectory=prolonged[o.trajectory]) if o.object_id in kept else o
            for o in visible
        )
    )


def _from_us(subject: ObjectState, start_us: int) -> int:
    """What an edit has put there is there from when it says."""
    return subject.trajectory.start_us if subject.edited else start_us


def _without_doubles(standing: list[ObjectState]) -> set[str]:
    longest = sorted(
        standing,
        key=lambda o: (o.trajectory.start_us - o.trajectory.end_us, o.instance_id),
    )
    kept: list[tuple[ObjectState, Float]] = []
    for subject in longest:
        pose = subject.trajectory.transform(subject.trajectory.start_us)
        if not any(
            boxes_overlap(pose, subject.scaled_size, other_pose, other.scaled_size)
            for other, other_pose in kept
        ):
            kept.append((subject, pose))
    return {subject.object_id for subject, _ in kept}


def _prolonged(trajectory: Trajectory, start_us: int, end_us: int) -> Trajectory:
    """The trajectory with its first pose from ``start_us`` on and its last one up to ``end_us``."""
    p, q, times = trajectory.positions, trajectory.quaternions, trajectory.times_us
    if start_us < times[0]:
        p, q = np.vstack([p[:1], p]), np.vstack([q[:1], q])
        times = np.concatenate([[start_us], times])
    if end_us > times[-1]:
        p, q = np.vstack([p, p[-1:]]), np.vstack([q, q[-1:]])
        times = np.concatenate([times, [end_us]])
    return Trajectory(times, p, q)
