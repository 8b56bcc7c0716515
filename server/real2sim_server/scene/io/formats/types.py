"""What every splat format can do, and what their readers share."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ....geometry.transform import Float
from ...cloud import GaussianCloud
from ...errors import BundleError, BundleTooLargeError

UpAxis = Literal["z", "y", "-y"]
"""Axis of a file that points up: ``y`` as in glTF (z forward), ``-y`` as in OpenCV and COLMAP."""

SMALLEST_SCALE = 1e-20
"""Scales whose exponential underflows are lifted to this [m], since a scale is positive."""


class SplatFormat(Protocol):
    """A format of splat files."""

    @property
    def name(self) -> str:
        """What the format is called in messages."""

    @property
    def suffix(self) -> str:
        """End of its file names, lower case, with the dot; chooses the format to write."""

    @property
    def has_signature(self) -> bool:
        """Whether the content tells the format; the others are told by ``suffix``."""

    @property
    def up_axis(self) -> UpAxis:
        """Axis that users of the format agree on to point up; else the scene's own, ``z``."""

    def recognises(self, head: bytes) -> bool:
        """Whether a file that starts with ``head`` (up to 64 KiB) is of this format.

        Always false where there is no signature.
        """

    def read(self, path: Path, *, max_bytes: int | None = None) -> GaussianCloud:
        """The Gaussians of a file, in the file's own frame and units.

        Args:
            path: the file.
            max_bytes: what they may take in memory; compared before anything is unpacked. None for
                any amount.

        Raises:
            BundleTooLargeError: they take more.
            BundleError: naming the file and the reason.
        """

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        """Write Gaussians of checked values, atomically, in the frame they are in.

        Raises:
            SceneError: for values the format cannot hold.
            OSError: the file cannot be written.
        """


def check_memory(path: Path, count: int, harmonics: int, max_bytes: int | None) -> None:
    """Refuse a file by what comes out of it, which says nothing of how small it is packed.

    Args:
        path: for the message.
        count, harmonics: of Gaussians, and of each one's spherical harmonics.
        max_bytes: what they may take in memory; None for any amount.

    Raises:
        BundleTooLargeError: they take more.
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
    """Raise BundleError unless ``element`` exists (``names`` is not None) with all ``needed``."""
    if names is None:
        raise BundleError(f"{path}: has no {element!r} element")
    missing = [name for name in needed if name not in names]
    if missing:
        raise BundleError(
            f"{path}: element {element!r} lacks the properties {missing}; "
            "a splat file needs them (a plain point cloud has no Gaussians)"
        )


def column(path: Path, records: NDArray[np.void], name: str, *, infinite: bool = False) -> Float:
    """A property [N] of records as float64.

    Raises:
        BundleError: for NaN and, unless ``infinite`` is allowed, for infinite values.
    """
    values = np.asarray(records[name], dtype=np.float64)
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
) -> NDArray[Any]:
    """Properties [N, len(names)] of records, finite; float64 where ``dtype`` names no other type.

    Raises like :func:`column`.
    """
    values = np.empty((len(records), len(names)), dtype=dtype)
    for index, name in enumerate(names):
        with np.errstate(over="ignore"):
            values[:, index] = column(path, records, name)
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
) -> GaussianCloud:
    """A cloud of parameters as files hold them: quats [N, 4] wxyz of any length, log scales.

    Arrays of float32 are not copied; whoever has many values hands them over so.

    Raises:
        BundleError: for quaternions of length zero and values beyond the range of float32.
    """
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    zero = norms[:, 0] < 1e-12
    if zero.any():
        raise BundleError(
            f"{path}: {int(zero.sum())} of {len(quats)} rotations have length zero, "
            f"the first at {int(np.argmax(zero))}"
        )
    with np.errstate(over="ignore", under="ignore"):
        scales = np.maximum(np.exp(log_scales), SMALLEST_SCALE)
        parts = {
            "means": means,
            "quats": quats / norms,
            "scales": scales,
            "opacities": opacities,
            "sh": sh,
        }
        arrays = {name: np.ascontiguousarray(v, dtype=np.float32) for name, v in parts.items()}
    for name, array in arrays.items():
        count = int((~np.isfinite(array)).sum())
        if count:
            raise BundleError(f"{path}: {count} values of {name} are beyond the range of float32")
    return GaussianCloud(**{name: torch.from_numpy(array) for name, array in arrays.items()})
