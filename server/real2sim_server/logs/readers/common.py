"""Common parts of log readers: tracks from boxes, clock matching, sweep motion, lenses."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, are_rigid, invert_transform
from ...scene import BrownConrady, Camera, SceneError, Shutter, Trajectory
from ...scene.camera import GLOBAL, Optics
from ...scene.errors import LeftOut
from ..driving_log import DrivingLog, LogError, ObjectTrack


@dataclass(frozen=True, eq=False)
class FrameBox:
    """One object in one frame.

    Attributes:
        key: name of the track in the dataset.
        category: the project's category.
        size: (length, width, height) [m].
        time_us: [us].
        T_world_object: [4, 4], origin at the box centre, x forward, z up.
        where: file and row, for errors.
    """

    key: str
    category: str
    size: tuple[float, float, float]
    time_us: int
    T_world_object: Float
    where: str


def upright_pose(centre: Iterable[float], heading: float) -> Float:
    """``T_frame_object`` [4, 4] of a box rotated about z by ``heading`` [rad]."""
    pose = np.eye(4)
    cos, sin = np.cos(heading), np.sin(heading)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:3, 3] = list(centre)
    return pose


def build_tracks(
    boxes: Iterable[FrameBox], left_out: LeftOut, *, own_numbers: bool = False
) -> tuple[tuple[ObjectTrack, ...], dict[str, str]]:
    """Tracks in order of first appearance, and the dataset's name of each by object id.

    An object has its median size and its most frequent category. Boxes without a positive size or
    a finite, rigid pose are left out, and all but the first of several boxes of one object at the
    same time.

    Args:
        boxes: of all objects and frames.
        left_out: collects the boxes left out, and categories that change within a track.
        own_numbers: the number in ``<category>_<number>`` is the dataset's name of the track.
    """
    by_key: dict[str, dict[int, FrameBox]] = defaultdict(dict)
    for box in sorted(boxes, key=lambda b: (b.time_us, b.key)):
        with left_out.damaged("boxes"):
            _check(box)
            if box.time_us in by_key[box.key]:
                raise LogError(f"{box.where}: {box.key!r} has two boxes at {box.time_us} us")
            by_key[box.key][box.time_us] = box
    numbers: Counter[str] = Counter()
    tracks, keys = [], {}
    for key, by_time in by_key.items():
        members = list(by_time.values())
        if not members:
            continue
        categories = Counter(b.category for b in members)
        category = categories.most_common(1)[0][0]
        for other, count in categories.items():
            if other != category:
                told = f"{key!r}: is a {category} in most frames, and a {other} in {count}"
                left_out["categories"].append(told)
        object_id = f"{category}_{key if own_numbers else numbers[category]}"
        numbers[category] += 1
        keys[object_id] = key
        length, width, height = np.median([b.size for b in members], axis=0).tolist()
        trajectory = Trajectory.from_transforms(
            np.array(list(by_time), dtype=np.int64), np.array([b.T_world_object for b in members])
        )
        tracks.append(ObjectTrack(object_id, category, (length, width, height), trajectory))
    return tuple(tracks), keys


def _check(box: FrameBox) -> None:
    if not (np.isfinite(box.size).all() and min(box.size) > 0):
        raise LogError(
            f"{box.where}: the box of {box.key!r} needs a positive length, width and height, not "
            f"{list(box.size)}"
        )
    pose = box.T_world_object
    if not are_rigid(pose):
        raise LogError(f"{box.where}: the pose of {box.key!r} is not finite, or not rigid")


def covered_frames(
    ego: Trajectory, times_us: NDArray[np.int64], left_out: LeftOut, where: str
) -> NDArray[np.intp]:
    """Indices of the frames that the ego poses cover; the others are left out.

    Raises:
        LogError: they cover no frame.
    """
    covered = (times_us >= ego.start_us) & (times_us <= ego.end_us)
    span = f"ego poses cover [{ego.start_us}, {ego.end_us}] us"
    if not covered.any():
        raise LogError(
            f"{where}: {span}, but the frames go from {times_us.min()} to {times_us.max()} us"
        )
    for t_us in times_us[~covered]:
        left_out["frames"].append(f"{where}: {span}, but not the frame at {t_us} us")
    return np.flatnonzero(covered)


# --- Image matching ------------------------------------------------------------------------------

# If cameras have their own clocks, each frame gets one image per camera.


@dataclass(frozen=True, eq=False)
class TimedImages:
    """Images of one camera: files and their time stamps [I] [us], increasing."""

    files: Sequence[Path]
    times_us: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MatchedImages:
    """Images by frame.

    Attributes:
        files: F files by camera; of an absent image, any.
        times_us: [F] time stamps by camera; of an absent image, the frame's.
        absent: (camera, frame) without an image.
    """

    files: dict[str, list[Path]]
    times_us: dict[str, NDArray[np.int64]]
    absent: frozenset[tuple[str, int]]


def match_images(
    frame_times_us: NDArray[np.int64],
    cameras: Mapping[str, TimedImages],
    *,
    tolerance_us: int,
    left_out: LeftOut,
    where: Path,
) -> MatchedImages:
    """The nearest image of every camera for every frame; an image belongs to one frame.

    Args:
        frame_times_us: [F] increasing.
        cameras: at least one image each.
        tolerance_us: maximum time between an image and its frame.
        left_out: collects the images that are absent.
        where: the log, for errors.
    """
    files, times_us, absent = {}, {}, set()
    for name, camera in cameras.items():
        index = _nearest(frame_times_us, camera.times_us)
        owner = _nearest(camera.times_us[index], frame_times_us)
        near = np.abs(camera.times_us[index] - frame_times_us) <= tolerance_us
        found = near & (owner == np.arange(len(frame_times_us)))
        files[name] = [camera.files[i] for i in index]
        times_us[name] = np.where(found, camera.times_us[index], frame_times_us)
        for i in np.flatnonzero(~found).tolist():
            absent.add((name, i))
            kind = "images" if name.islower() else "sweeps"
            left_out[kind].append(
                f"{where}: {name!r} recorded nothing within {tolerance_us * 1e-6:g} s of the frame "
                f"at {frame_times_us[i]} us"
            )
    return MatchedImages(files, times_us, frozenset(absent))


def _nearest(wanted: NDArray[np.int64], given: NDArray[np.int64]) -> NDArray[np.intp]:
    after = np.clip(np.searchsorted(given, wanted), 1, max(len(given) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(given) - 1)
    closer = np.abs(given[before] - wanted) <= np.abs(given[after] - wanted)
    return np.asarray(np.where(closer, before, after))


# --- Selection of a drive ------------------------------------------------------------------------

SHOWN = 20


def select_sequence(folder: Path, known: list[str], sequence: str | None) -> str:
    """``sequence``, or the only known one.

    Raises:
        LogError: no sequence exists, ``sequence`` is not among them, or several require a name.
    """
    if not known:
        raise LogError(f"{folder}: holds no sequence")
    if sequence is None and len(known) == 1:
        return known[0]
    if sequence is None or sequence not in known:
        asked = "name one with sequence" if sequence is None else f"there is no {sequence!r}"
        more = f" and {len(known) - SHOWN} more" if len(known) > SHOWN else ""
        raise LogError(f"{folder}: holds the sequences {known[:SHOWN]}{more}; {asked}")
    return sequence


# --- Motion within a sweep -----------------------------------------------------------------------

# Moves the points of a sweep to one instant, by the motion of the vehicle.


def compensate_sweep(
    points: Float, offset: Float, vehicle_poses: Float, frame: int
) -> NDArray[np.float32]:
    """Motion-compensated points, as if all had been measured at the frame's time stamp in a static
    world.

    Between frames the vehicle moves with constant velocity and constant angular velocity; before
    the first and after the last frame it moves as in the nearest interval.

    Args:
        points: [N, 3] float64, vehicle frame at each point's own time [m].
        offset: [N] float64, that time relative to the frame's, in frame periods.
        vehicle_poses: ``T_world_vehicle`` [F, 4, 4] of all frames.
        frame: index of the frame.

    Returns:
        [N, 3] float32, vehicle frame at the frame's time stamp [m].
    """
    moved = points.copy()
    for direction in (-1, 1):
        chosen = offset < 0 if direction < 0 else offset > 0
        motion = _motion(vehicle_poses, frame, direction)
        moved[chosen] = _advance(points[chosen], np.abs(offset[chosen]), motion)
    return moved.astype(np.float32)


def _motion(vehicle_poses: Float, frame: int, direction: int) -> Float:
    """``T_here_there`` [4, 4] of the neighbouring frame, mirrored at the ends of the log."""
    here = invert_transform(vehicle_poses[frame])
    if 0 <= frame + direction < len(vehicle_poses):
        towards: Float = here @ vehicle_poses[frame + direction]
        return towards
    if len(vehicle_poses) == 1:
        return np.eye(4)
    return invert_transform(here @ vehicle_poses[frame - direction])


def _advance(points: Float, fraction: Float, motion: Float) -> Float:
    """Apply ``fraction`` [N] of a rigid motion to points [N, 3] (Rodrigues' formula)."""
    rotation = motion[:3, :3]
    angle = np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1))
    skew = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    length = np.linalg.norm(skew)
    shift = fraction[:, None] * motion[:3, 3]
    if length < 1e-12:
        return points + shift
    axis = skew / length
    turn = (fraction * angle)[:, None]
    cross = np.cross(axis, points)
    along = (points @ axis)[:, None] * axis
    turned: Float = points * np.cos(turn) + cross * np.sin(turn) + along * (1 - np.cos(turn))
    return turned + shift


# --- Lenses --------------------------------------------------------------------------------------

# Logs provide pinhole images; distorted ones are rectified.

MAX_ZOOM = 4.0


@dataclass(frozen=True, eq=False)
class Lens:
    """A Brown-Conrady lens (Brown 1966, in OpenCV's notation).

    Attributes:
        width, height: image size [px].
        K: [3, 3] float64, intrinsics of the images as recorded, pixel centres at +0.5.
        distortion: k1, k2, p1, p2, k3; all zero for a pinhole.
    """

    width: int
    height: int
    K: Float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @cached_property
    def pinhole_K(self) -> Float:
        """``K`` [3, 3] of the undistorted images, which have the same size.

        The lens's own K with focal lengths increased just enough that every pixel is inside the
        recorded image: undistorted images have no black corners.
        """
        if not any(self.distortion) or self._fits(1.0):
            return self.K.copy()
        low, high = 1.0, MAX_ZOOM
        for _ in range(40):
            middle = (low + high) / 2
            low, high = (low, middle) if self._fits(middle) else (middle, high)
        return self._zoomed(high)

    def camera(self, name: str, T_vehicle_camera: Float, shutter: Shutter = GLOBAL) -> Camera:
        """The pinhole camera of the undistorted images, with the original lens and shutter.

        A lens that folds inside the image is omitted, because it cannot be rendered.
        """
        pinhole = Camera(name, self.width, self.height, self.pinhole_K, T_vehicle_camera)
        k1, k2, p1, p2, k3 = self.distortion
        distorted = any(self.distortion)
        if not distorted and not shutter.rolls:
            return pinhole
        model = BrownConrady((k1, k2, k3, 0.0, 0.0, 0.0), (p1, p2)) if distorted else None
        try:
            return replace(pinhole, recorded=Optics(self.K, model, shutter))
        except SceneError:
            return pinhole

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The pinhole image of a recorded image, both RGB uint8 [height, width, 3]."""
        import cv2

        if not any(self.distortion):
            return image
        columns, rows = self._source
        return np.asarray(
            cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )

    def distort(self, pixels: Float) -> Float:
        """Recorded image positions [..., 2] of positions [..., 2] in the pinhole image [px]."""
        return self._recorded(pixels, self.pinhole_K)

    @cached_property
    def _source(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        column, row = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        recorded = self.distort(np.stack([column, row], axis=-1)) - 0.5
        return recorded[..., 0].astype(np.float32), recorded[..., 1].astype(np.float32)

    def _zoomed(self, zoom: float) -> Float:
        k = self.K.copy()
        k[0, 0] *= zoom
        k[1, 1] *= zoom
        return k

    def _fits(self, zoom: float) -> bool:
        column, row = np.arange(self.width + 1.0), np.arange(self.height + 1.0)
        border = np.concatenate(
            [np.stack([column, np.full_like(column, y)], 1) for y in (0, self.height)]
            + [np.stack([np.full_like(row, x), row], 1) for x in (0, self.width)]
        )
        found = self._recorded(border, self._zoomed(zoom))
        return bool((found >= 0).all() and (found <= [self.width, self.height]).all())

    def _recorded(self, pixels: Float, pinhole: Float) -> Float:
        k1, k2, p1, p2, k3 = self.distortion
        x = (pixels[..., 0] - pinhole[0, 2]) / pinhole[0, 0]
        y = (pixels[..., 1] - pinhole[1, 2]) / pinhole[1, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        u = (x * radial + dx) * self.K[0, 0] + self.K[0, 2]
        v = (y * radial + dy) * self.K[1, 1] + self.K[1, 2]
        return np.stack([u, v], axis=-1)


# --- The reader protocol -------------------------------------------------------------------------


class LogReader(Protocol):
    """Reads one dataset layout.

    Attributes:
        name: the format's name, for ``open_log(format=...)``.
        expects: one line for users with the required content of the folder, or the file.
    """

    name: str
    expects: str

    def recognises(self, path: Path) -> bool:
        """Whether the folder or file has this layout; cheap, and never raises."""
        ...

    def read(self, path: Path, *, sequence: str | None = None) -> DrivingLog:
        """The log at ``path``; images and sweeps are read on demand.

        ``sequence`` selects one in a folder with several; a single one is the default.

        Raises:
            LogError: names the file (and line), the problem and the expected content. Tables are
                checked here; images and sweeps when they are read, or by ``check_log``. A record
                that cannot be used is left out, and ``DrivingLog.left_out`` says so.
        """
        ...
