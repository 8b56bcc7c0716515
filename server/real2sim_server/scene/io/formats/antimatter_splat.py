"""The headerless ``.splat`` of early web viewers: 32 bytes a splat, no view-dependent colour.

Facts: github.com/antimatter15/splat, main.js.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...._files import atomic_file
from ...cloud import GaussianCloud
from ...errors import BundleError
from ...spherical_harmonics import SH_C0
from .types import UpAxis, build_cloud, check_memory, host_array

RECORD = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)]
)


class AntimatterSplat:
    """Records of position, linear scale (float32), RGBA and rotation wxyz (bytes).

    Axes: none are prescribed; files made of trained splats have y down like those. Both ways keep
    the coordinates as they are.

    Quantisation: positions and scales keep their bits; colours and opacities are multiples of
    1/255, colours clamped to [0, 1]; parts of the quaternion are multiples of 1/128. Spherical
    harmonics past the first are lost.
    """

    name = "antimatter15 .splat"
    suffix = ".splat"
    has_signature = False
    up_axis: UpAxis = "z"

    def recognises(self, head: bytes) -> bool:
        """Never: there is no header."""
        return False

    def read(self, path: Path, *, max_bytes: int | None = None) -> GaussianCloud:
        """The Gaussians of a file. Raises BundleError naming the file and the reason."""
        nbytes = path.stat().st_size
        if nbytes % RECORD.itemsize:
            raise BundleError(
                f"{path}: truncated or no .splat file: {nbytes} bytes are no multiple of "
                f"{RECORD.itemsize}"
            )
        check_memory(path, nbytes // RECORD.itemsize, 1, max_bytes)
        records = np.fromfile(path, dtype=RECORD)
        for name, bad in {
            "position": ~np.isfinite(records["position"]),
            "scale": ~(np.isfinite(records["scale"]) & (records["scale"] >= 0)),
        }.items():
            count = int(bad.any(axis=1).sum())
            if count:
                raise BundleError(
                    f"{path}: {name} is NaN, infinite or negative in {count} of {len(records)} "
                    f"splats, the first at {int(np.argmax(bad.any(axis=1)))}"
                )
        with np.errstate(divide="ignore"):
            log_scales = np.log(records["scale"].astype(np.float64))
        rgba = records["rgba"] / 255.0
        return build_cloud(
            path,
            means=records["position"],
            quats=(records["rotation"].astype(np.float64) - 128) / 128,
            log_scales=log_scales,
            opacities=rgba[:, 3],
            sh=((rgba[:, :3] - 0.5) / SH_C0).astype(np.float32)[:, None, :],
        )

    def write(self, cloud: GaussianCloud, path: Path) -> None:
        """Write ``cloud``, largest and most opaque splats first, as viewers load it in order.

        Raises:
            OSError: the file cannot be written.
        """
        records = np.empty(len(cloud), dtype=RECORD)
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
