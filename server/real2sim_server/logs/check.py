"""Checks of a log: its files, and values that look wrong (frames, units and orders)."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from real2sim_proto.conventions import CLASS_OF_CATEGORY

from ..geometry import Float, apply_transform, invert_transform, quaternion_to_matrix
from ..scene import Camera, CameraRig, Trajectory
from .drawing import points_in_box
from .driving_log import (
    ChecksFiles,
    DrivingLog,
    LidarSweep,
    LogError,
    ObjectTrack,
    damage_named,
    left_out_lines,
)

# --- Files ----------------------------------------------------------------------------------------

MAX_DISTANCE_M = 100_000.0
"""Maximum distance from the world origin [m]; single precision has a resolution of 8 mm there."""
MAX_INCOMPLETE = 0.2
"""Maximum share of frames without an image or a sweep that the other frames have."""


@dataclass(frozen=True)
class LogCheck:
    """Findings of :func:`check_log`.

    Attributes:
        images, sweeps: number of checked files.
        bad_images: one sentence for each unusable image, by (camera, frame); it names the file.
        bad_sweeps: one sentence for each unusable sweep, by frame; it names the file. A sweep
            without points is unusable if other frames have points.
    """

    images: int
    sweeps: int
    bad_images: Mapping[tuple[str, int], str]
    bad_sweeps: Mapping[int, str]


def check_log(
    log: DrivingLog,
    *,
    contents: bool = True,
    on_progress: Callable[[int, int], None] | None = None,
) -> LogCheck:
    """Check every file of a log; a bad file does not stop the check.

    Args:
        log: any log.
        contents: decode every image and read every sweep. Otherwise only headers are read, if the
            source has them (:class:`ChecksFiles`): the header of each image gives its size, its end
            mark shows whether it is complete, the header of each sweep lists its arrays.
        on_progress: called with (done, total) after each frame.
    """
    bad_images: dict[tuple[str, int], str] = {}
    bad_sweeps: dict[int, str] = {}
    points: dict[int, int | None] = {}
    images = 0
    for frame in range(log.frame_count):
        for camera in log.rig.names:
            if log.has_image(camera, frame):
                images += 1
                try:
                    _check_image(log, camera, frame, contents=contents)
                except LogError as error:
                    bad_images[camera, frame] = str(error)
        if frame not in log.absent_sweeps:
            try:
                points[frame] = _check_sweep(log, frame, contents=contents)
            except LogError as error:
                bad_sweeps[frame] = str(error)
        if on_progress is not None:
            on_progress(frame + 1, log.frame_count)
    sweeps = len(points) + len(bad_sweeps)
    if any(count != 0 for count in points.values()):
        for frame, count in points.items():
            if count == 0:
                bad_sweeps[frame] = f"sweep of frame {frame}: has no points"
    return LogCheck(images, sweeps, bad_images, dict(sorted(bad_sweeps.items())))


def _check_image(log: DrivingLog, camera: str, frame: int, *, contents: bool) -> None:
    where, t_us = f"image of camera {camera!r} at frame {frame}", log.image_time_us(camera, frame)
    if not log.ego.covers(t_us):
        span = f"[{log.ego.start_us}, {log.ego.end_us}] us"
        raise LogError(f"{where}: was taken at {t_us} us, but ego poses cover {span}")
    if contents:
        log.image(camera, frame)
    elif isinstance(log.source, ChecksFiles):
        with damage_named(where):
            log.source.check_image(camera, frame)


def _check_sweep(log: DrivingLog, frame: int, *, contents: bool) -> int | None:
    """Number of points, if known."""
    if contents:
        return len(log.lidar(frame).points)
    if isinstance(log.source, ChecksFiles):
        with damage_named(f"sweep of frame {frame}"):
            return log.source.check_sweep(frame)
    return None


def leave_out(log: DrivingLog, check: LogCheck) -> DrivingLog:
    """``log`` without the bad images and sweeps of ``check``, and cameras without any image."""
    bad = log.absent_images | check.bad_images.keys()
    told = {kind: list(sentences) for kind, sentences in log.left_out.items()}
    cameras, image_times_us = [], dict(log.image_times_us)
    for camera in log.rig:
        if all((camera.name, frame) in bad for frame in range(log.frame_count)):
            reason = next(
                (t for (name, _), t in check.bad_images.items() if name == camera.name), ""
            )
            told.setdefault("cameras", []).append(
                f"camera {camera.name!r}: has no usable image{reason and f' ({reason})'}"
            )
            image_times_us.pop(camera.name, None)
        else:
            cameras.append(camera)
    names = {camera.name for camera in cameras}
    bad = frozenset((name, frame) for name, frame in bad if name in names)
    no_sweep = log.absent_sweeps | check.bad_sweeps.keys()
    for kind, sentences in (
        ("images", [text for (name, _), text in check.bad_images.items() if name in names]),
        ("sweeps", list(check.bad_sweeps.values())),
    ):
        if sentences:
            told.setdefault(kind, []).extend(sentences)
    return replace(
        log,
        rig=log.rig if len(cameras) == len(log.rig) else CameraRig(tuple(cameras)),
        image_times_us=image_times_us,
        absent_images=bad,
        absent_sweeps=frozenset(no_sweep),
        left_out={kind: tuple(sentences) for kind, sentences in told.items()},
    )


def usable_log(
    log: DrivingLog,
    *,
    strict: bool = False,
    on_progress: Callable[[int, int], None] | None = None,
) -> DrivingLog:
    """``log`` without the images and sweeps that cannot be read; reads all of them.

    Args:
        log: any log.
        strict: refuse a log of which anything is left out.
        on_progress: called with (done, total) after each frame.

    Raises:
        LogError: times, poses or boxes cannot be used, more than a fifth of the frames lack an
            image or a sweep, or ``strict`` and something is left out. The message lists it.
    """
    rest = leave_out(log, check_log(log, on_progress=on_progress))
    if found := problems_of(rest, strict=strict):
        raise LogError("\n".join(found))
    return rest


def problems_of(log: DrivingLog, *, strict: bool = False) -> list[str]:
    """Reasons why :func:`usable_log` refuses a log, one line each; empty for a good log."""
    found = [*_cameras(log), *_times(log), *_place(log), *_tracks(log)]
    lost = len(log.left_out.get("frames", ()))
    incomplete = len({frame for _, frame in log.absent_images} | log.absent_sweeps) + lost
    frames = log.frame_count + lost
    if incomplete > MAX_INCOMPLETE * frames:
        found += [
            f"log {log.name!r}: {incomplete} of {frames} frames lack an image, a sweep or a pose; "
            f"at most {MAX_INCOMPLETE:.0%} may",
            *left_out_lines(log.left_out),
            "write these files again, or select other frames or cameras",
        ]
    elif strict and log.left_out:
        found += [f"log {log.name!r} is not complete:", *left_out_lines(log.left_out)]
    return found


def _cameras(log: DrivingLog) -> Iterator[str]:
    if len(log.rig):
        return
    known = log.left_out.get("cameras", ())
    named = f"it has no usable camera ({'; '.join(known)})" if known else "it has no cameras"
    yield (
        f"log {log.name!r} cannot be trained on: {named}; put the images where the data set has "
        "them (LiDAR and boxes can be used as they are)"
    )


def _times(log: DrivingLog) -> Iterator[str]:
    times = log.frame_times_us
    if len(times) == 0 or (np.diff(times) <= 0).any():
        yield f"log {log.name!r}: frame times must increase strictly, at least one"
    for camera in log.rig.names:
        given = log.image_times_us.get(camera, times)
        if given.shape != times.shape:
            yield (
                f"log {log.name!r}: camera {camera!r} has {len(given)} image times for "
                f"{len(times)} frames"
            )


def _place(log: DrivingLog) -> Iterator[str]:
    far = float(np.abs(log.ego.positions).max())
    if far > MAX_DISTANCE_M:
        yield (
            f"log {log.name!r}: its drive is {far / 1e3:,.0f} km from the world's origin, where "
            f"Gaussians could only move in steps of {float(np.spacing(np.float32(far))):.2g} m; "
            "subtract the first pose's position from all poses and boxes"
        )


def _tracks(log: DrivingLog) -> Iterator[str]:
    names: set[str] = set()
    for track in log.tracks:
        if track.object_id in names:
            yield f"log {log.name!r}: object {track.object_id!r} is there twice"
        names.add(track.object_id)
        if not (np.isfinite(track.size).all() and min(track.size) > 0):
            yield (
                f"log {log.name!r}: object {track.object_id!r} needs a positive length, width and "
                f"height, not {track.size}"
            )


# --- Plausibility ---------------------------------------------------------------------------------

# Hints for the owner of the log; they are not errors. If a typical mistake explains a value, the
# hint names it.

GAP_FACTOR = 1.6
"""Time step, relative to the median, from which a frame counts as missing."""
MIN_RATE, MAX_RATE = 0.2, 500.0
"""Plausible frame rates [1/s]; outside this range, times are probably not in microseconds."""
PRECISE_DISTANCE_M = 10_000.0
"""Distance from the world origin at which the float32 resolution of Gaussians is 1 mm [m]."""
MAX_EGO_SPEED = 70.0
OFF_HEADING, RIGHT_HEADING = math.radians(45), math.radians(15)
FRAME_OF_BOXES = "T_world_object, not of the vehicle's frame, x forward"
MANY_OFF = 0.3
"""Minimum fraction of misaligned vehicles for a hint; a few may drive backwards."""
DRIVEN_STEP_M = 0.3
"""Minimum distance of two poses for a direction of motion."""
MIN_DRIVEN_M = 1.0
"""Minimum length of a drive for depths from images alone [m]."""
MIN_UP = 0.3
"""Minimum z component of an axis that should point up."""
CAMERA_REACH = np.array([15.0, 4.0]), (-0.5, 6.0)
"""Maximum distance of a camera from the rear axle along x and y, and its range of heights [m]."""
NEAR_BOXES = 30.0
FAR_BOXES = 150.0
STANDING_M, FLOATS_M = 15.0, 0.6
"""Maximum distance of boxes that are tested for ground contact, and tolerance [m]."""
FEW_POINTS = 5
BETWEEN_SWEEPS_M, SWEEPS_AHEAD = 1.5, 20
"""Distance of the ego between two compared sweeps, and maximum number of frames in between."""
COMPARED_POINTS = 4000
ABOVE_TRAFFIC_M, AROUND_BOX_M = 2.0, 0.3
BETTER = 0.6
"""Maximum distance ratio at which an alternative alignment of sweeps counts as better."""

VEHICLES = ("car", "van", "truck", "bus")
CATEGORIES = (*CLASS_OF_CATEGORY, "animal", "other")
"""Known categories of objects."""
MANY_UNKNOWN = 0.2
"""Minimum fraction of objects of an unknown category for a hint."""
AXES_OF_CV = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Columns: x right, y down, z forward, in a frame of x forward, y left, z up."""


def questions_to(log: DrivingLog, sweeps: Mapping[int, LidarSweep]) -> list[str]:
    """Suspicious properties of a log, in plain words; empty for a good log.

    Args:
        log: any log.
        sweeps: some of its sweeps, by frame; empty if none could be read. One or two more are read.
    """
    found = [*_odd_times(log), *_world(log), *_ego(log)]
    for camera in log.rig:
        found += _camera(camera)
    found += [*_categories(log.tracks), *_headings(log.tracks), *_sizes(log.tracks)]
    if not sweeps:
        return found
    if not any(len(s.points) for s in sweeps.values()):
        return [*found, *_images_alone(log)]
    if not log.tracks:
        found.append("there are no boxes: moving objects have to be tracked first")
    found += [*_intensity(sweeps), *_ground(sweeps), *_boxes(log, sweeps), *_standing(log, sweeps)]
    return found + _registration(log)


def gaps_between(steps: Float) -> tuple[tuple[int, float], ...]:
    """(frame before it, length [s]) of each gap among steps [F - 1] between frames [s]."""
    if len(steps) < 2:
        return ()
    wide = np.flatnonzero(steps > GAP_FACTOR * np.median(steps))
    return tuple((int(i), float(steps[i])) for i in wide)


def ego_steps(log: DrivingLog) -> Float:
    """Distance of the ego from frame to frame, [F - 1] [m]."""
    positions = np.array([log.ego.pose(int(t))[0] for t in log.frame_times_us])
    return np.asarray(np.linalg.norm(np.diff(positions, axis=0), axis=1))


def _images_alone(log: DrivingLog) -> list[str]:
    """What a log without LiDAR can be used for."""
    driven = float(ego_steps(log).sum())
    found = [
        "there is no LiDAR: reconstruct takes depths from features that images have in common; "
        "track and fit-lidar need LiDAR"
    ]
    if driven < MIN_DRIVEN_M:
        found.append(
            f"the ego drives {driven:.1f} m: without LiDAR, depths need images from several places"
        )
    return found


def _odd_times(log: DrivingLog) -> list[str]:
    steps = np.diff(log.frame_times_us) * 1e-6
    if not len(steps):
        return []
    rate = 1 / float(np.median(steps))
    if not MIN_RATE <= rate <= MAX_RATE:
        unit = "milliseconds or seconds" if rate > MAX_RATE else "nanoseconds"
        return [f"{rate:.4g} frames a second: are times in {unit}? They must be in microseconds"]
    found = [f"{s:.2f} s pass after frame {i}: are frames missing?" for i, s in gaps_between(steps)]
    speed = ego_steps(log) / steps
    if speed.max() > MAX_EGO_SPEED:
        frame = int(speed.argmax())
        found.append(f"the ego jumps after frame {frame} ({speed[frame]:.0f} m/s)")
    return found


def _world(log: DrivingLog) -> list[str]:
    far = float(np.abs(log.ego.positions).max())
    if far <= PRECISE_DISTANCE_M:
        return []
    return [
        f"the drive is {far / 1e3:,.0f} km from the world's origin, where single precision is "
        f"{float(np.spacing(np.float32(far))) * 1e3:.2g} mm: subtract the first pose's position "
        "from all poses and boxes"
    ]


# --- poses ------------------------------------------------------------------------------------


def _ego(log: DrivingLog) -> list[str]:
    ups = np.array([quaternion_to_matrix(q)[2, 2] for q in log.ego.quaternions])
    off = _off_heading(log.ego)
    if np.median(ups) >= MIN_UP and (off is None or off <= OFF_HEADING):
        return []
    seen = (
        f"the ego's z axis is {math.degrees(math.acos(np.median(ups).clip(-1, 1))):.0f} degrees "
        "from up"
        if np.median(ups) < MIN_UP or off is None
        else f"the ego drives {math.degrees(off):.0f} degrees off its x axis"
    )
    if _makes_sense(_inverted(log.ego)):
        return [f"{seen}: are its poses inverted? They must be T_world_vehicle"]
    return [f"{seen}: {_explained(log.ego, 'T_world_vehicle, its x axis forward and z up')}"]


def _headings(tracks: tuple[ObjectTrack, ...]) -> list[str]:
    moving = [t for t in tracks if t.category in VEHICLES and t.trajectory.moves]
    offs = [(off, t) for t in moving if (off := _off_heading(t.trajectory)) is not None]
    wrong = [t for off, t in offs if off > OFF_HEADING]
    if len(wrong) < max(2, MANY_OFF * len(offs)):
        return []
    answers = Counter(_explained(t.trajectory, FRAME_OF_BOXES) for t in wrong)
    return [
        f"{len(wrong)} of {len(offs)} moving vehicles do not drive along the x axis of their box: "
        f"{answers.most_common(1)[0][0]}"
    ]


def _explained(path: Trajectory, expected: str) -> str:
    """The mistake that would explain a trajectory, or the expected one."""
    swapped = Trajectory(path.times_us, path.positions, path.quaternions[:, [3, 0, 1, 2]])
    if _makes_sense(swapped):
        return "are its quaternions x y z w? They must be w x y z"
    return f"are its poses {expected}?"


def _inverted(path: Trajectory) -> Trajectory:
    inverse = [invert_transform(path.transform(int(t))) for t in path.times_us]
    return Trajectory.from_transforms(path.times_us, inverse)


def _makes_sense(path: Trajectory) -> bool:
    ups = [quaternion_to_matrix(q)[2, 2] for q in path.quaternions]
    off = _off_heading(path)
    return off is not None and off < RIGHT_HEADING and float(np.median(ups)) > 1 - MIN_UP


def _off_heading(path: Trajectory) -> float | None:
    """Median angle between direction of motion and x axis [rad]; None without motion."""
    kept = [0]
    for i, position in enumerate(path.positions):
        if np.linalg.norm(position[:2] - path.positions[kept[-1], :2]) > DRIVEN_STEP_M:
            kept.append(i)
    if len(kept) < 3:
        return None
    ways = np.diff(path.positions[kept, :2], axis=0)
    # The axis at the middle of an arc has its direction; at the ends it leads or lags.
    middle = [(a + b) // 2 for a, b in pairwise(kept)]
    axes = np.array([quaternion_to_matrix(path.quaternions[i])[:2, 0] for i in middle])
    crossed = ways[:, 0] * axes[:, 1] - ways[:, 1] * axes[:, 0]
    return float(np.median(np.abs(np.arctan2(crossed, (ways * axes).sum(axis=1)))))


# --- cameras ----------------------------------------------------------------------------------


def _camera(camera: Camera) -> list[str]:
    found = []
    pose = camera.T_vehicle_camera
    if not _sits_on_a_vehicle(pose):
        x, y, z = pose[:3, 3]
        tilt = math.degrees(math.acos(float(np.clip(-pose[2, 1], -1, 1))))
        found.append(
            f"camera {camera.name!r} sits at ({x:.1f}, {y:.1f}, {z:.1f}) m, the top of its image "
            f"{tilt:.0f} degrees from up: {_mounted_wrongly(pose)}"
        )
    (fx, _, cx), (_, _, cy) = camera.K[0], camera.K[1]
    across = math.degrees(2 * math.atan(camera.width / 2 / fx))
    centred = 0.3 <= cx / camera.width <= 0.7 and 0.1 <= cy / camera.height <= 0.9
    if not (centred and 3.0 <= across <= 160.0):
        found.append(
            f"camera {camera.name!r} is {across:.0f} degrees wide with its centre at "
            f"({cx:.0f}, {cy:.0f}) of {camera.width} x {camera.height} px: is K of another size?"
        )
    return found


def _mounted_wrongly(pose: Float) -> str:
    if _sits_on_a_vehicle(invert_transform(pose)):
        return "is T_vehicle_camera inverted?"
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3] @ AXES_OF_CV
    if _sits_on_a_vehicle(turned):
        return "is its frame x forward, z up? It must be x right, y down, z forward (OpenCV)"
    return "is T_vehicle_camera of the frame on the ground below the rear axle?"


def _sits_on_a_vehicle(pose: Float) -> bool:
    reach, (low, high) = CAMERA_REACH
    near = bool((np.abs(pose[:2, 3]) <= reach).all()) and low <= pose[2, 3] <= high
    return near and float(-pose[2, 1]) >= MIN_UP


# --- objects ----------------------------------------------------------------------------------


def _categories(tracks: tuple[ObjectTrack, ...]) -> list[str]:
    """Categories that look misspelt, or that are unknown and common."""
    unknown = Counter(t.category for t in tracks if t.category not in CATEGORIES)
    found = []
    for category, count in sorted(unknown.items()):
        like = difflib.get_close_matches(category.lower(), CATEGORIES, n=1, cutoff=0.7)
        if like or count > MANY_UNKNOWN * len(tracks):
            meant = f"did you mean {like[0]!r}?" if like else f"known: {', '.join(CATEGORIES)}"
            found.append(
                f"{count} objects are of category {category!r}, which gets the mass and the label "
                f"of 'other'; {meant}"
            )
    return found


def _sizes(tracks: tuple[ObjectTrack, ...]) -> list[str]:
    sizes = np.array([t.size for t in tracks if t.category in VEHICLES])
    if not len(sizes):
        return []
    length, width, height = np.median(sizes, axis=0)
    found = []
    if (sizes[:, 1] > sizes[:, 0]).mean() > 0.5 or height > 1.5 * length:
        found.append(
            f"vehicles are {length:.1f} m long, {width:.1f} m wide and {height:.1f} m high: is "
            "size length, width, height?"
        )
    if not 1.0 <= max(length, width) <= 25.0:
        found.append(f"vehicles are {max(length, width):.3g} m long: is size in metres?")
    return found


def _boxes(log: DrivingLog, sweeps: Mapping[int, LidarSweep]) -> list[str]:
    held = near = 0
    away = []
    for frame, sweep in sweeps.items():
        here = log.ego.transform(int(log.frame_times_us[frame]))
        points = apply_transform(here, sweep.points.astype(np.float64))
        for track, pose in _poses(log, frame):
            away.append(float(np.linalg.norm(pose[:2, 3] - here[:2, 3])))
            if away[-1] < NEAR_BOXES:
                near += 1
                held += points_in_box(points, pose, track.size) >= FEW_POINTS
    if away and min(away) > FAR_BOXES:
        return [f"the nearest box is {min(away):,.0f} m away: are they in the world's frame?"]
    if near < 3 or held >= near / 3:
        return []
    return [
        f"only {held} of {near} boxes within {NEAR_BOXES:.0f} m hold LiDAR points: are they in the "
        "right frame?"
    ]


def _standing(log: DrivingLog, sweeps: Mapping[int, LidarSweep]) -> list[str]:
    """Whether nearby boxes touch the road."""
    bottoms = []
    for frame in sweeps:
        to_vehicle = invert_transform(log.ego.transform(int(log.frame_times_us[frame])))
        for track, pose in _poses(log, frame):
            x, y, z = (to_vehicle @ pose[:, 3])[:3].tolist()
            if track.category in VEHICLES and math.hypot(x, y) < STANDING_M:
                bottoms.append((z - track.size[2] / 2, track.size[2]))
    if len(bottoms) < 3:
        return []
    bottom, height = np.median(np.array(bottoms), axis=0)
    if abs(bottom) <= FLOATS_M:
        return []
    half = abs(bottom + height / 2) < 0.3
    why = "is their position on the road? It must be the box's centre" if half else "is z right?"
    return [f"nearby vehicles are {bottom:+.1f} m above the road: {why}"]


def _poses(log: DrivingLog, frame: int) -> list[tuple[ObjectTrack, Float]]:
    t_us = int(log.frame_times_us[frame])
    here = [t for t in log.tracks if t.trajectory.covers(t_us)]
    return [(t, t.trajectory.transform(t_us)) for t in here]


# --- LiDAR ------------------------------------------------------------------------------------


def _intensity(sweeps: Mapping[int, LidarSweep]) -> list[str]:
    largest = max((float(s.intensity.max()) for s in sweeps.values() if len(s.points)), default=0.0)
    if largest <= 1.0:
        return []
    return [f"LiDAR intensity is up to {largest:.4g}: scale it to the range from 0 to 1"]


def _ground(sweeps: Mapping[int, LidarSweep]) -> list[str]:
    heights = []
    for sweep in sweeps.values():
        x, y, z = sweep.points.T
        beside = (np.abs(x) < 12) & (np.abs(y) < 5) & ((np.abs(x) > 3) | (np.abs(y) > 1.5))
        if beside.sum() > 100:
            heights.append(float(np.percentile(z[beside], 10)))
    if not heights or abs(np.median(heights)) < 0.5:
        return []
    return [
        f"the road near the vehicle is at z = {np.median(heights):+.1f} m in the vehicle frame, "
        "not at 0: is the LiDAR's pose right?"
    ]


def _registration(log: DrivingLog) -> list[str]:
    """Whether the ego's motion brings one sweep onto another."""
    pair = _compared_frames(log)
    if pair is None:
        return []
    try:
        one, other = (_standing_points(log, frame) for frame in pair)
    except LogError:
        return []  # The complete check names the file.
    if min(len(one), len(other)) < 100:
        return []
    first, second = (log.ego.transform(int(log.frame_times_us[frame])) for frame in pair)
    motion = invert_transform(second) @ first
    tree = cKDTree(other)

    def apart(moved: Float) -> float:
        return float(np.median(tree.query(apply_transform(moved, one))[0]))

    given, still, backward = (apart(m) for m in (motion, np.eye(4), invert_transform(motion)))
    between = f"frames {pair[0]} and {pair[1]}"
    if backward < BETTER * min(given, still):
        return [
            f"sweeps of {between} fit best ({backward:.2f} m, as given {given:.2f} m) where the "
            "ego moves backwards: are its poses inverted? They must be T_world_vehicle"
        ]
    if still < BETTER * given:
        return [
            f"sweeps of {between} fit best ({still:.2f} m, as given {given:.2f} m) where the ego "
            "stands still: are points in the world's frame? They must be in the vehicle's"
        ]
    return []


def _compared_frames(log: DrivingLog) -> tuple[int, int] | None:
    """The first pair of frames with enough motion of the ego in between."""
    way = np.concatenate([[0.0], np.cumsum(ego_steps(log))])
    for first in range(len(way)):
        later = way[first + 1 : first + 1 + SWEEPS_AHEAD] - way[first]
        far = np.flatnonzero(later > BETWEEN_SWEEPS_M)
        if len(far):
            return first, first + 1 + int(far[0])
    return None


def _standing_points(log: DrivingLog, frame: int) -> Float:
    """Static points: outside boxes, and above the road and most traffic.

    Road points would match under any motion.
    """
    sweep = log.lidar(frame)
    points = sweep.points.astype(np.float64)
    away = np.linalg.norm(points - sweep.origin, axis=1)
    kept = points[(away < 40.0) & (points[:, 2] > np.median(points[:, 2]) + ABOVE_TRAFFIC_M)]
    to_vehicle = invert_transform(log.ego.transform(int(log.frame_times_us[frame])))
    for track, pose in _poses(log, frame):
        local = apply_transform(invert_transform(to_vehicle @ pose), kept)
        kept = kept[(np.abs(local) > np.array(track.size) / 2 + AROUND_BOX_M).any(axis=1)]
    return np.asarray(kept[:: max(1, len(kept) // COMPARED_POINTS)])
