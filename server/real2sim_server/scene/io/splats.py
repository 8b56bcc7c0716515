"""Splat files of other programs: formats, reading, writing, and import as scenes and assets."""

from __future__ import annotations

import hashlib
import re
from os import PathLike
from pathlib import Path
from typing import Any, Literal, cast, overload

import numpy as np
import torch

from ...geometry import Float, quaternion_to_matrix, yaw_quaternion
from ..asset import Asset
from ..camera import T_VEHICLE_OPTICAL, Camera, CameraRig
from ..cloud import GaussianCloud
from ..errors import BundleError, SceneError
from ..scene import Scene
from ..trajectory import Trajectory
from .ply import InriaPly, PlayCanvasPly
from .splat_format import AntimatterSplat, SplatFormat, UpAxis
from .spz import Spz

HEAD_BYTES = 1 << 16

FORMATS: list[SplatFormat] = [PlayCanvasPly(), InriaPly(), Spz(), AntimatterSplat()]
"""All formats in order of precedence, for contents and for file names."""

_ROTATIONS: dict[str, list[list[float]]] = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "y": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "-y": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
}
"""Rotations from the file's axes to x forward, y left, z up. ``y`` follows glTF (z forward), ``-y``
OpenCV and COLMAP (z forward, x right).
"""

MAX_REACH = 1e6
"""Maximum coordinate and scale of imported splats [m]; float32 has steps of 6 cm there."""

VIEW_DURATION_US = 10_000_000
"""Duration of the stationary ego in an imported scene, enough for a drive through it."""


def register_format(splat_format: SplatFormat) -> None:
    """Add a format from outside the package; it takes precedence over the existing ones.

    Raises:
        ValueError: another format has that name or suffix.
    """
    for known in FORMATS:
        if splat_format.name == known.name or splat_format.suffix == known.suffix:
            raise ValueError(f"{known.name} ({known.suffix}) is registered already")
    FORMATS.insert(0, splat_format)


def suffixes() -> tuple[str, ...]:
    """File name suffixes of all formats, in the order of comparison."""
    return tuple(splat_format.suffix for splat_format in FORMATS)


def read_splats(
    path: str | PathLike[str], *, max_bytes: int | None = None, notes: list[str] | None = None
) -> GaussianCloud:
    """Read a splat file of any known format, in its own frame and units.

    Args:
        path: the file.
        max_bytes: memory limit of its Gaussians; None for no limit.
        notes: receives a sentence for each kind of data that is left out or not used as it is.
            None refuses such a file.

    Raises:
        BundleTooLargeError: the limit is exceeded.
        BundleError: names the file and the reason: missing, unknown format, truncated, wrong
            counts, values that are not finite, rotations of length zero.
    """
    file = Path(path)
    head = _head(file)
    for splat_format in FORMATS:
        if splat_format.recognises(head):
            return splat_format.read(file, max_bytes=max_bytes, notes=notes)
    for splat_format in FORMATS:
        if not splat_format.has_signature and file.name.lower().endswith(splat_format.suffix):
            return splat_format.read(file, max_bytes=max_bytes, notes=notes)
    known = ", ".join(f.name for f in FORMATS)
    raise BundleError(f"{file}: not a ply nor any other known splat format; known are: {known}")


def write_splats(
    cloud: GaussianCloud, path: str | PathLike[str], *, up_axis: UpAxis | None = None
) -> None:
    """Write ``cloud`` in the format of the file name suffix, atomically, in its own frame.

    ``.compressed.ply``, ``.ply``, ``.spz`` (version 3) or ``.splat``; the class of each format
    documents its rounding.

    Args:
        cloud: the Gaussians.
        path: file to write.
        up_axis: axis that points up, written to the header of a ply. None: unknown.

    Raises:
        SceneError: another suffix, values that are not finite or out of range, or not
            representable in the format.
        OSError: the file cannot be written.
    """
    file = Path(path)
    splat_format = format_to_write(file)
    cloud.check_values(f"cloud for {file}")
    if up_axis is not None and isinstance(splat_format, InriaPly | PlayCanvasPly):
        splat_format.write(cloud, file, comment=f"up_axis {up_axis}")
    else:
        splat_format.write(cloud, file)


def up_axis_of(path: str | PathLike[str]) -> UpAxis | None:
    """The up axis of a splat file, if its format (spz) or its header defines it.

    Raises:
        BundleError: it cannot be read.
    """
    head = _head(Path(path))
    if head.startswith(b"ply"):
        said = re.search(rb"^comment up_axis (z|y|-y)\r?$", head.split(b"end_header")[0], re.M)
        return cast("UpAxis", said[1].decode()) if said else None
    known = (f.up_axis for f in FORMATS if f.recognises(head))
    # A format without a convention uses the axis of scenes.
    return next((axis for axis in known if axis != "z"), None)


def format_to_write(path: Path) -> SplatFormat:
    """The format that the name of ``path`` ends with.

    Raises:
        SceneError: the suffix is unknown.
    """
    for splat_format in FORMATS:
        if path.name.lower().endswith(splat_format.suffix):
            return splat_format
    raise SceneError(f"{path}: no splat format ends so; allowed are {', '.join(suffixes())}")


@overload
def import_splats(
    path: str | PathLike[str],
    *,
    name: str,
    as_asset: Literal[False] = False,
    up_axis: UpAxis | None = None,
    yaw: float = 0.0,
    scale: float = 1.0,
    max_bytes: int | None = None,
) -> Scene: ...


@overload
def import_splats(
    path: str | PathLike[str],
    *,
    name: str,
    as_asset: Literal[True],
    category: str = "object",
    up_axis: UpAxis | None = None,
    yaw: float = 0.0,
    scale: float = 1.0,
    max_bytes: int | None = None,
) -> Asset: ...


def import_splats(
    path: str | PathLike[str],
    *,
    name: str,
    as_asset: bool = False,
    category: str = "object",
    up_axis: UpAxis | None = None,
    yaw: float = 0.0,
    scale: float = 1.0,
    max_bytes: int | None = None,
) -> Scene | Asset:
    """Read a splat file as a scene (background only) or as an asset (centred on its box).

    Args:
        path: splat file of any known format.
        name: name of the scene, or id of the asset.
        as_asset: make an asset instead of a scene.
        category: class of the asset.
        up_axis: axis of the file that points up; trained splats mostly have ``-y``. None: from its
            format or header (:func:`up_axis_of`), else ``z``. The provenance has the axis, and in
            ``notes`` what was left out or not used as it is.
        yaw: rotation about z after that [rad], to align the front of an object with x.
        scale: metres per unit of the file.
        max_bytes: memory limit of its Gaussians; None for no limit.

    Raises:
        BundleTooLargeError: the limit is exceeded.
        BundleError: like :func:`read_splats`, and for a file without splats.
        SceneError: an unknown ``up_axis`` or a scale that is not positive.
    """
    file = Path(path)
    notes: list[str] = []
    cloud = read_splats(file, max_bytes=max_bytes, notes=notes)
    stated = up_axis_of(file)
    if up_axis is None and stated is None:
        notes.append(
            "the file does not say which axis points up: z is used; for most trained splats, set "
            "up_axis to -y"
        )
    up_axis = up_axis or stated or "z"
    if not len(cloud):
        raise BundleError(f"{file}: holds no splats; nothing to import")
    placed = within_reach(cloud.moved(upright(up_axis, yaw), scale=scale), file, notes)
    provenance = {
        "source": "splat file",
        "file": file.name,
        "sha256": _file_hash(file),
        "up_axis": up_axis,
        "yaw": yaw,
        "scale": scale,
        "notes": notes,
    }
    if as_asset:
        return asset_from_cloud(placed, name=name, category=category, provenance=provenance)
    return scene_from_cloud(placed, name=name, provenance=provenance)


def within_reach(cloud: GaussianCloud, file: Path, notes: list[str]) -> GaussianCloud:
    """``cloud`` [m] without splats that are too far away or too wide for float32."""
    far = (cloud.means.abs() > MAX_REACH).any(dim=1)
    wide = (cloud.scales > MAX_REACH).any(dim=1)
    bad = far | wide
    if not bad.any():
        return cloud
    sentence = (
        f"{int(bad.sum())} of {len(cloud)} splats are more than {MAX_REACH / 1000:g} km from the "
        f"origin ({int(far.sum())}) or as wide ({int(wide.sum())})"
    )
    if bad.all():
        raise BundleError(
            f"{file}: {sentence}; no splat is left. Check the unit, and subtract an offset from "
            "geographic coordinates"
        )
    notes.append(f"{sentence}: they are left out")
    return cloud.select(torch.nonzero(~bad)[:, 0])


def asset_from_cloud(
    cloud: GaussianCloud, *, name: str, category: str, provenance: dict[str, Any]
) -> Asset:
    """An asset of ``cloud`` (x forward, z up [m]), moved to the centre of its robust box."""
    low, high = robust_bounds(cloud)
    to_centre = np.eye(4)
    to_centre[:3, 3] = -(low + high) / 2
    length, width, height = np.maximum(high - low, 1e-3).tolist()
    return Asset(name, category, (length, width, height), cloud.moved(to_centre), provenance)


def scene_from_cloud(
    cloud: GaussianCloud,
    *,
    name: str,
    provenance: dict[str, Any],
    times_us: tuple[int, int] = (0, VIEW_DURATION_US),
) -> Scene:
    """A scene with ``cloud`` as background, seen along x by one camera that covers its robust box.

    The ego is stationary behind the box during ``times_us``. Its camera ``front`` looks at the
    centre of the box.
    """
    low, high = robust_bounds(cloud)
    centre, extent = (low + high) / 2, np.maximum(high - low, 1e-3)
    focal, width, height = 800.0, 960, 640
    # Near face of the box fits into the image with a tenth to spare.
    distance = 1.1 * focal * max(extent[1] / width, extent[2] / height)
    position = [low[0] - distance, centre[1], low[2]]
    pose = T_VEHICLE_OPTICAL.copy()
    pose[2, 3] = centre[2] - low[2]
    camera = Camera(
        "front",
        width,
        height,
        np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]),
        pose,
    )
    times = np.array(times_us, dtype=np.int64)
    ego = Trajectory(times, np.array([position] * 2), np.array([[1.0, 0, 0, 0]] * 2))
    return Scene(name, cloud, {}, None, CameraRig((camera,)), ego, times, provenance=provenance)


def robust_bounds(cloud: GaussianCloud, *, opacity: float = 0.1) -> tuple[Float, Float]:
    """Lowest and highest corner [3] [m] of the visible part, without floaters.

    Between the 0.5 and 99.5 percentiles of the centres of Gaussians above ``opacity``; of all
    Gaussians if none is.
    """
    visible = cloud.means[cloud.opacities >= opacity]
    means = (visible if len(visible) else cloud.means).detach().cpu().numpy().astype(np.float64)
    low, high = np.percentile(means, [0.5, 99.5], axis=0)
    return low, high


def _head(file: Path) -> bytes:
    try:
        with file.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except OSError as error:
        raise BundleError(f"{file}: cannot be read: {error.strerror}") from error


def upright(up_axis: str, yaw: float) -> Float:
    """Rotation ``T_scene_file`` [4, 4] for files with ``up_axis`` up, followed by ``yaw`` [rad].

    Raises:
        SceneError: an unknown axis or a yaw that is not finite.
    """
    if up_axis not in _ROTATIONS:
        raise SceneError(f"up_axis {up_axis!r}; allowed are {list(_ROTATIONS)}")
    if not np.isfinite(yaw):
        raise SceneError(f"yaw must be finite, not {yaw}")
    turn = np.eye(4)
    turn[:3, :3] = quaternion_to_matrix(yaw_quaternion(yaw)) @ np.array(_ROTATIONS[up_axis])
    return turn


def _file_hash(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
