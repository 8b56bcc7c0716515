"""Summaries of scene and asset bundles, read without their Gaussians."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import CameraRig
from ..coverage import Coverage
from ..errors import BundleError, SceneError
from ..ground import Ground
from ..lane_graph import LaneGraph
from ..trajectory import Trajectory
from .bundle import load_coverage, load_ground, load_lanes
from .container import check_file, cloud_shapes, figure_shapes, read_container
from .document import UNCERTAINTIES, AssetDocument, Bounds, SceneDocument, Vector3


@dataclass(frozen=True, eq=False)
class ObjectSummary:
    """An object without its Gaussians.

    Attributes:
        object_id, category, size, trajectory: as in SceneObject.
        gaussians: number of Gaussians.
    """

    object_id: str
    category: str
    size: Vector3
    trajectory: Trajectory
    gaussians: int


@dataclass(frozen=True, eq=False)
class SceneSummary:
    """A scene bundle without its Gaussians.

    Attributes:
        path: folder of the bundle.
        name, content_hash, rig, ego, ego_size, frame_times_us, provenance: as in Scene.
        objects: in the scene's order.
        background_gaussians: number of Gaussians of the background.
        sky_resolution: edge length of the sky's faces [px], 0 without sky.
        bounds: lowest and highest Gaussian centre of the background [m], None without any.
        nbytes: size of the tensor files, about the memory of the scene [bytes].
        has_uncertainties: as in Scene.
        lane_count: lanes of its graph; 0 without one.
    """

    path: Path
    name: str
    content_hash: str
    rig: CameraRig
    ego: Trajectory
    ego_size: Vector3
    frame_times_us: NDArray[np.int64]
    provenance: Mapping[str, Any]
    objects: tuple[ObjectSummary, ...]
    background_gaussians: int
    sky_resolution: int
    bounds: Bounds | None
    nbytes: int
    has_uncertainties: bool
    lane_count: int

    @cached_property
    def ground(self) -> Ground:
        """The ground of the scene, read on first access; fitted then for older bundles.

        Raises:
            BundleError: the bundle is damaged, or another one has replaced it.
        """
        return load_ground(self.path, self.content_hash)

    @cached_property
    def lanes(self) -> LaneGraph | None:
        """The lanes of the scene, read on first access; None without lanes.

        Raises:
            BundleError: the bundle is damaged, or another one has replaced it.
        """
        return load_lanes(self.path, self.content_hash) if self.lane_count else None

    @cached_property
    def coverage(self) -> Coverage | None:
        """What images saw of the scene, as in Scene; its files are opened on first access.

        Raises:
            BundleError: the bundle is damaged, or another one has replaced it.
        """
        return load_coverage(self.path, self.content_hash) if self.has_uncertainties else None

    @property
    def gaussian_count(self) -> int:
        """Gaussians of background and objects together."""
        return self.background_gaussians + sum(o.gaussians for o in self.objects)

    @property
    def start_us(self) -> int:
        """Start of the ego path [us]."""
        return self.ego.start_us

    @property
    def end_us(self) -> int:
        """End of the ego path [us]."""
        return self.ego.end_us


def read_scene_summary(path: str | PathLike[str]) -> SceneSummary:
    """Read only ``scene.json`` of a bundle; hashes are not compared.

    Raises:
        BundleError: not a scene bundle, a newer version, or an invalid document.
    """
    folder = Path(path)
    document = read_container(folder, SceneDocument, verify=False)
    try:
        return _summary(folder, document)
    except (SceneError, OverflowError) as error:
        raise BundleError(f"{folder}: {error}") from error


@dataclass(frozen=True, eq=False)
class AssetSummary:
    """An asset bundle without its Gaussians.

    Attributes:
        asset_id, category, size, provenance, content_hash: as in Asset.
        gaussians: their number.
        nbytes: their memory [bytes].
    """

    asset_id: str
    category: str
    size: Vector3
    provenance: Mapping[str, Any]
    content_hash: str
    gaussians: int
    nbytes: int


def read_asset_summary(path: str | PathLike[str]) -> AssetSummary:
    """Read only the document of an asset bundle and the size of its file.

    Raises:
        BundleError: not an asset bundle, a newer version, truncated, or an invalid document.
    """
    folder = Path(path)
    document = read_container(folder, AssetDocument, verify=False)
    for name, nbytes in document.files.items():
        check_file(folder / Path(name).name, nbytes)
    cloud = document.content.cloud
    shapes = cloud_shapes(cloud.gaussians, cloud.sh_degree, known=cloud.tensors)
    figure = figure_shapes(cloud.gaussians) if document.content.figure else {}
    joints, weights = (math.prod(figure.get(name, (0,))) for name in ("joints", "weights"))
    return AssetSummary(
        asset_id=document.name,
        category=document.content.category,
        size=document.content.size,
        provenance=document.provenance,
        content_hash=document.content_hash,
        gaussians=cloud.gaussians,
        nbytes=4 * sum(math.prod(shape) for shape in shapes.values()) + joints + 4 * weights,
    )


def _summary(folder: Path, document: SceneDocument) -> SceneSummary:
    content = document.content
    return SceneSummary(
        path=folder,
        name=document.name,
        content_hash=document.content_hash,
        rig=content.build_rig(),
        ego=content.ego.trajectory.build(),
        ego_size=content.ego.size,
        has_uncertainties=UNCERTAINTIES in content.background.tensors,
        frame_times_us=np.array(content.frame_times_us, dtype=np.int64),
        provenance=document.provenance,
        objects=tuple(
            ObjectSummary(o.object_id, o.category, o.size, o.trajectory.build(), o.cloud.gaussians)
            for o in content.objects
        ),
        background_gaussians=content.background.gaussians,
        sky_resolution=content.sky.resolution if content.sky else 0,
        bounds=document.bounds,
        nbytes=sum(document.files.values()),
        lane_count=len(content.lanes.document.get("lanes", ())) if content.lanes else 0,
    )
