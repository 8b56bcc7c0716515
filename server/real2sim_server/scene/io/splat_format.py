"""The protocol of splat formats, helpers for their readers, and the headerless ``.splat``.

``.splat`` comes from early web viewers: 32 bytes per splat, no view-dependent colour. Source:
github.com/antimatter15/splat, main.js.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ..._files import atomic_file
from ...geometry import Float
from ..cloud import SH_C0, GaussianCloud
from ..errors import BundleError, BundleTooLargeError

UpAxis = Literal["z", "y", "-y"]
"""Axis of a file that points up: ``y`` as in glTF (z forward), ``-y`` as in OpenCV and COLMAP."""

MIN_SCALE = 1e-20
"""Minimum scale [m]. Scales must be positive, even if their exponential underflows."""


class SplatFormat(Protocol):
    """A format of splat files."""

    @property
    def name(self) -> str:
        """Name of the format in messages."""

    @property
    def suffix(self) -> str:
        """Suffix of its file names, lower case, with the dot; selects the format to write."""

    @property
    def has_signature(self) -> bool:
        """Whether the content identifies the format, else ``suffix`` does."""

    @property
    def up_axis(self) -> UpAxis:
        """Up axis by convention of the format; ``z`` if it has none."""

    def recognises(self, head: bytes) -> bool:
        """Whether a file that starts with ``head`` (up to 64 KiB) has this format.

        Always false for formats without a signature.
        """

    def read(
        self, path: Path, *, max_bytes: int | None = None, notes: list[str] | None = None
    ) -> GaussianCloud:
        """The Gaussians of a file, in the file's own frame and units.

        Args:
            path: the file.
            max_bytes: memory limit, checked before anything is unpacked. None for no limit.
            notes: receives a sentence for each kind of data that is left out or not used as it is,
                see :func:`note`. None refuses such a file.

        Raises:
            BundleTooLargeError: the limit is exceeded.
            BundleError: names the file and the reason.
        """

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        """Write Gaussians with checked values atomically, without a change of frame.

        Raises:
            SceneError: for values the format cannot hold.
            OSError: the file cannot be written.
        """


def note(path: Path, notes: list[str] | None, found: str, done: str) -> None:
    """Add to ``notes`` what was found in the file and what was done about it.

    Raises:
        BundleError: there are no ``notes``; the message says what was found.
    """
    if notes is None:
        raise BundleError(f"{path}: {found}")
    notes.append(f"{found}: {done}")


def check_memory(path: Path, count: int, harmonics: int, max_bytes: int | None) -> None:
    """Reject a file by its unpacked size, independent of its compressed size.

    Args:
        path: file name for the message.
        count, harmonics: number of Gaussians, and of spherical harmonics of each.
        max_bytes: memory limit; None for no limit.

    Raises:
        BundleTooLargeError: the limit is exceeded.
    """
    needed = 4 * count * (11 + 3 * harmonics)
    if max_bytes is not None and needed > max_bytes:
        raise BundleTooLargeError(
            f"{path}: {count} splats with {harmonics} harmonics take {needed} bytes of memory; "
            f"allowed are {max_bytes}"
        )


def require_properties(
    path: Path, element: str, names: tuple[str, ...] | None, needed: tuple[str, ...]
) -> None:
    """Raise BundleError unless ``element`` exists (``names`` is not None) and has ``needed``."""
    if names is None:
        raise BundleError(f"{path}: has no {element!r} element")
    missing = [name for name in needed if name not in names]
    if missing:
        raise BundleError(
            f"{path}: element {element!r} lacks the properties {missing}; "
            "a splat file needs them (a plain point cloud has no Gaussians)"
        )


def column(
    path: Path,
    records: NDArray[np.void],
    name: str,
    *,
    infinite: bool = False,
    notes: list[str] | None = None,
) -> Float:
    """A property [N] of records as float64.

    Raises:
        BundleError: without ``notes``, for NaN and, unless ``infinite`` is allowed, for infinite
            values. With them, :func:`build_cloud` leaves such splats out.
    """
    values = np.asarray(records[name], dtype=np.float64)
    if notes is not None:
        return values
    bad = np.isnan(values) if infinite else ~np.isfinite(values)
    if bad.any():
        raise BundleError(
            f"{path}: property {name!r} is NaN{'' if infinite else ' or infinite'} in "
            f"{int(bad.sum())} of {len(values)} splats, the first at {int(np.argmax(bad))}"
        )
    return values


def columns(
    path: Path,
    records: NDArray[np.void],
    names: tuple[str, ...],
    dtype: type[np.floating[Any]] = np.float64,
    notes: list[str] | None = None,
) -> NDArray[Any]:
    """Properties [N, len(names)] of records; float64 unless ``dtype`` names another type.

    Raises like :func:`column`.
    """
    values = np.empty((len(records), len(names)), dtype=dtype)
    for index, name in enumerate(names):
        with np.errstate(over="ignore"):
            values[:, index] = column(path, records, name, notes=notes)
    return values


def host_array(tensor: torch.Tensor) -> Float:
    """Values of a tensor as float64 on the host."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def build_cloud(
    path: Path,
    *,
    means: NDArray[np.floating[Any]],
    quats: NDArray[np.floating[Any]],
    log_scales: NDArray[np.floating[Any]],
    opacities: NDArray[np.floating[Any]],
    sh: NDArray[np.floating[Any]],
    notes: list[str] | None = None,
) -> GaussianCloud:
    """A cloud from parameters as stored in files: quats [N, 4] wxyz of any length, log scales.

    Arrays of float32 are not copied, to save memory. Splats with values that are not finite in
    float32 are left out; rotations of length zero do not rotate. Both are in the ``notes``.

    Raises:
        BundleError: no splat is left; without ``notes``, also for values that would be in them.
    """
    count = len(means)
    with np.errstate(over="ignore", under="ignore", invalid="ignore", divide="ignore"):
        norms = np.linalg.norm(quats, axis=1, keepdims=True)
        zero = norms[:, 0] < 1e-12
        scales = np.maximum(np.exp(log_scales), MIN_SCALE)
        parts = {
            "means": means,
            "quats": np.where(zero[:, None], np.array([1.0, 0.0, 0.0, 0.0]), quats / norms),
            "scales": scales,
            "opacities": opacities,
            "sh": sh,
        }
        arrays = {name: np.ascontiguousarray(v, dtype=np.float32) for name, v in parts.items()}
    if zero.any():
        note(
            path,
            notes,
            f"{int(zero.sum())} of {count} rotations have length zero, the first at "
            f"{int(np.argmax(zero))}",
            "these splats are not rotated",
        )
    bad = {k: ~np.isfinite(v.reshape(count, -1)).all(axis=1) for k, v in arrays.items() if count}
    unusable = np.any(list(bad.values()), axis=0) if count else np.zeros(0, bool)
    if unusable.any():
        where = ", ".join(f"{int(rows.sum())} {k}" for k, rows in bad.items() if rows.any())
        sentence = (
            f"{int(unusable.sum())} of {count} splats have values that are NaN, infinite or beyond "
            f"the range of float32 ({where})"
        )
        if unusable.all():
            raise BundleError(f"{path}: {sentence}; no splat is left")
        note(path, notes, sentence, "they are left out")
        arrays = {name: array[~unusable] for name, array in arrays.items()}
    return GaussianCloud(**{name: torch.from_numpy(array) for name, array in arrays.items()})


# The headerless ``.splat``.

SPLAT_RECORD = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)


class AntimatterSplat:
    """Records of position, linear scale (float32), RGBA and rotation wxyz (bytes).

    Axes: not prescribed; files from trained splats are y down like their source. Reading and
    writing preserve the coordinates.

    Quantisation: positions and scales keep their bits; colours and opacities are multiples of
    1/255, colours clamped to [0, 1]; quaternion components are multiples of 1/128. Spherical
    harmonics past the first are lost.
    """

    name = "antimatter15 .splat"
    suffix = ".splat"
    has_signature = False
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        """Always false: there is no header."""
        return False

    def read(
        self, path: Path, *, max_bytes: int | None = None, notes: list[str] | None = None
    ) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        nbytes = path.stat().st_size
        if nbytes % SPLAT_RECORD.itemsize:
            raise BundleError(
                f"{path}: truncated, or not a .splat file: {nbytes} bytes are not a multiple of "
                f"{SPLAT_RECORD.itemsize}"
            )
        check_memory(path, nbytes // SPLAT_RECORD.itemsize, 1, max_bytes)
        records = np.fromfile(path, dtype=SPLAT_RECORD)
        for name, bad in {
            "position": ~np.isfinite(records["position"]),
            "scale": ~(np.isfinite(records["scale"]) & (records["scale"] >= 0)),
        }.items():
            count = int(bad.any(axis=1).sum())
            if count and notes is None:
                raise BundleError(
                    f"{path}: {name} is NaN, infinite or negative in {count} of {len(records)} "
                    f"splats, the first at {int(np.argmax(bad.any(axis=1)))}"
                )
        with np.errstate(divide="ignore", invalid="ignore"):
            log_scales = np.log(records["scale"].astype(np.float64))
        rgba = records["rgba"] / 255.0
        return build_cloud(
            path,
            means=records["position"],
            quats=(records["rotation"].astype(np.float64) - 128) / 128,
            log_scales=log_scales,
            opacities=rgba[:, 3],
            sh=((rgba[:, :3] - 0.5) / SH_C0).astype(np.float32)[:, None, :],
            notes=notes,
        )

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        """Write ``cloud``, largest and most opaque splats first, as viewers load it in order.

        Raises:
            OSError: the file cannot be written.
        """
        records = np.empty(len(cloud), dtype=SPLAT_RECORD)
        opacities, scales = host_array(cloud.opacities), host_array(cloud.scales)
        rgb = 0.5 + SH_C0 * host_array(cloud.sh[:, 0])
        rgba = np.concatenate([rgb, opacities[:, None]], axis=1)
        quats = host_array(cloud.quats)
        records["position"] = cloud.means.detach().cpu().numpy()
        records["scale"] = cloud.scales.detach().cpu().numpy()
        records["rgba"] = np.clip(np.rint(rgba * 255), 0, 255)
        records["rotation"] = np.clip(np.rint(quats * 128 + 128), 0, 255)
        with np.errstate(divide="ignore"):
            importance = np.log(scales).sum(axis=1) + np.log(opacities)
        with atomic_file(path) as file:
            file.write(records[np.argsort(-importance, kind="stable")].tobytes())
