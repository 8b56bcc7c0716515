"""INRIA-style PLY of 3D Gaussian Splatting (Kerbl et al. 2023): parameters before activation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...._files import atomic_file
from ...cloud import SH_DEGREES, GaussianCloud
from ...errors import BundleError
from ..ply import read_ply_elements
from .types import UpAxis, build_cloud, check_memory, column, columns, require_properties

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

LARGEST_LOGIT = 40.0
"""Opacities of 0 and 1 have no finite logit; in float32 this one stands for them."""


class InriaPly:
    """One ``vertex`` element; log scales, logit opacities, rotation wxyz, f_rest channel-major.

    Properties may come in any order and number type; normals and unknown ones are skipped.
    """

    name = "INRIA ply"
    suffix = ".ply"
    has_signature = True
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        """Whether ``head`` is that of a PLY file; the compressed kind is asked before."""
        return head.startswith((b"ply\n", b"ply\r\n"))

    def read(self, path: Path, *, max_bytes: int | None = None) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        elements = read_ply_elements(path)
        vertex = elements.get("vertex")
        names = vertex.dtype.names or () if vertex is not None else None
        require_properties(path, "vertex", names, POSITION + DC + ("opacity",) + SCALE + ROTATION)
        assert vertex is not None
        rest = _rest_properties(path, vertex)
        check_memory(path, len(vertex), 1 + len(rest) // 3, max_bytes)
        logits = column(path, vertex, "opacity", infinite=True)
        with np.errstate(over="ignore"):
            opacities = 1 / (1 + np.exp(-logits))
        return build_cloud(
            path,
            means=columns(path, vertex, POSITION, np.float32),
            quats=columns(path, vertex, ROTATION),
            log_scales=columns(path, vertex, SCALE),
            opacities=opacities,
            sh=_spherical_harmonics(path, vertex, rest),
        )

    def write(self, cloud: GaussianCloud, path: Path, *, comment: str = "") -> None:
        """Write ``cloud``; see :func:`write_ply`."""
        write_ply(cloud, path, comment=comment)


def write_ply(cloud: GaussianCloud, path: Path, *, comment: str = "") -> None:
    """Write ``cloud`` as an INRIA-style binary little-endian PLY, atomically.

    Positions and harmonics keep their bits; scales and opacities pass through log and logit in
    float64 and are exact to float32 rounding. Normals are written as zeros, as viewers expect.

    Raises:
        OSError: the file cannot be written.
    """
    rest = 3 * (cloud.sh.shape[1] - 1)
    names = POSITION + NORMAL + DC + _rest_names(rest) + ("opacity",) + SCALE + ROTATION
    sh = cloud.sh.detach().cpu().numpy()
    opacities = cloud.opacities.detach().cpu().numpy().astype(np.float64)
    with np.errstate(divide="ignore"):
        logits = np.log(opacities) - np.log1p(-opacities)
    parts = [
        cloud.means.detach().cpu().numpy(),
        np.zeros((len(cloud), 3)),
        sh[:, 0],
        sh[:, 1:].transpose(0, 2, 1).reshape(len(cloud), rest),
        np.clip(logits, -LARGEST_LOGIT, LARGEST_LOGIT)[:, None],
        np.log(cloud.scales.detach().cpu().numpy().astype(np.float64)),
        cloud.quats.detach().cpu().numpy(),
    ]
    header = "\n".join(
        ["ply", "format binary_little_endian 1.0"]
        + [f"comment {comment}"] * bool(comment)
        + [f"element vertex {len(cloud)}"]
        + [f"property float {name}" for name in names]
        + ["end_header\n"]
    )
    with atomic_file(path) as file:
        file.write(header.encode("ascii"))
        file.write(np.concatenate(parts, axis=1).astype("<f4").tobytes())


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _rest_properties(path: Path, vertex: NDArray[np.void]) -> tuple[str, ...]:
    """Names of the harmonics past the first, once they are of a whole degree."""
    given = [name for name in vertex.dtype.names or () if name.startswith("f_rest_")]
    names = _rest_names(len(given))
    if set(given) != set(names) or len(names) // 3 + 1 not in SH_DEGREES or len(names) % 3:
        raise BundleError(
            f"{path}: {len(given)} f_rest properties; allowed are f_rest_0 to f_rest_8, _23, _44 "
            "without gaps, or none"
        )
    return names


def _spherical_harmonics(
    path: Path, vertex: NDArray[np.void], rest: tuple[str, ...]
) -> NDArray[np.float32]:
    """Coefficients [N, K, 3]; the file holds those past the first channel by channel."""
    per_channel = len(rest) // 3
    sh = np.empty((len(vertex), 1 + per_channel, 3), dtype=np.float32)
    sh[:, 0] = columns(path, vertex, DC, np.float32)
    for channel in range(3):
        names = rest[channel * per_channel : (channel + 1) * per_channel]
        sh[:, 1:, channel] = columns(path, vertex, names, np.float32)
    return sh
