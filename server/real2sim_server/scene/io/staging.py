"""Imports in a confined process: an untrusted file becomes a checked bundle in a folder.

The importer calls :func:`stage_scene` and :func:`stage_asset`. They run the functions below in a
confined process and leave a bundle that only needs renaming to its final path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..._confined import ConfinedError, Limits, run_confined
from ..errors import BundleError, BundleTooLargeError, SceneError
from .bundle import load_scene, save_asset, save_scene
from .splat_format import UpAxis
from .splats import import_splats, up_axis_of

MIB = 1024**2
LOADED_EARLY = ("cv2", "scipy.ndimage", "scipy.spatial")
"""Modules that the starter of confined processes loads first: the ground fit needs them."""


@dataclass(frozen=True)
class StagingLimits:
    """Limits of one import.

    Attributes:
        max_bytes: memory of the resulting Gaussians.
        memory_bytes: of the process that reads, mapped files included.
        seconds: of one import.
    """

    max_bytes: int
    memory_bytes: int
    seconds: float


class StagingError(SceneError):
    """The bundle cannot be written; the message is the system's reason."""


def stage_scene(source: Path, folder: Path, *, name: str, limits: StagingLimits) -> None:
    """Read a bundle or splat file and write it as a new bundle at ``folder``.

    Raises:
        BundleTooLargeError: it takes more memory than the limits allow.
        BundleError: it cannot be read, or took too long.
        SceneError: its values are no scene, or the bundle cannot be written.
    """
    _staged("read_and_save_scene", source, folder, limits, {"name": name})


def stage_asset(
    source: Path, folder: Path, *, asset_id: str, options: Mapping[str, Any], limits: StagingLimits
) -> None:
    """Read a splat file and write it as a new asset bundle at ``folder``.

    Args:
        source: the splat file.
        folder: of the bundle; its parent exists.
        asset_id: name of the asset.
        options: ``category``, ``up_axis`` and ``yaw`` as :func:`~.splats.import_splats` takes them,
            and ``length`` [m], None for that of the file.
        limits: of the import.

    Raises:
        BundleTooLargeError, BundleError, SceneError: as :func:`stage_scene`.
    """
    _staged("read_and_save_asset", source, folder, limits, {"asset_id": asset_id, **options})


def _staged(
    function: str, source: Path, folder: Path, limits: StagingLimits, options: dict[str, Any]
) -> None:
    places = {"source": str(source.absolute()), "folder": str(folder.absolute())}
    try:
        run_confined(
            f"{__name__}:{function}",
            places | {"max_bytes": limits.max_bytes} | options,
            limits=Limits(
                memory_bytes=limits.memory_bytes,
                seconds=limits.seconds,
                written_bytes=2 * limits.max_bytes + 64 * MIB,
            ),
            errors=(BundleTooLargeError, BundleError, SceneError, StagingError),
        )
    except ConfinedError as error:
        kind = BundleTooLargeError if error.out_of_memory else BundleError
        raise kind(f"{source}: reading it {error}") from error


def read_and_save_scene(source: str, folder: str, *, max_bytes: int, name: str) -> None:
    """The confined part of :func:`stage_scene`."""
    file = Path(source)
    if file.is_dir():
        scene = load_scene(file)
    else:
        scene = import_splats(file, name=name, max_bytes=max_bytes)
    if scene.nbytes > max_bytes:
        raise BundleTooLargeError(
            f"{source}: the scene takes {scene.nbytes} bytes of memory; allowed are {max_bytes}"
        )
    try:
        save_scene(scene, folder)
    except OSError as error:
        raise StagingError(error.strerror or str(error)) from error


def read_and_save_asset(
    source: str,
    folder: str,
    *,
    max_bytes: int,
    asset_id: str,
    category: str,
    up_axis: UpAxis | None,
    yaw: float,
    length: float | None,
) -> None:
    """The confined part of :func:`stage_asset`."""
    raw = import_splats(
        Path(source),
        name=asset_id,
        as_asset=True,
        category=category,
        # Most files without axes come from trainers that look along z.
        up_axis=up_axis or up_axis_of(source) or "-y",
        yaw=yaw,
        max_bytes=max_bytes,
    )
    factor = (length or raw.size[0]) / raw.size[0]
    x, y, z = (side * factor for side in raw.size)
    cloud = raw.cloud.moved(np.eye(4), scale=factor)
    provenance = dict(raw.provenance) | {"scale": factor}
    asset = replace(raw, cloud=cloud, size=(x, y, z), provenance=provenance)
    try:
        save_asset(asset, folder)
    except OSError as error:
        raise StagingError(error.strerror or str(error)) from error
