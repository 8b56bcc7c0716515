"""The centres of a scene's Gaussians at an instant, as plain points with colour and normal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import GROUND, STATIC

from ..geometry.rotation import quaternion_to_matrix
from ..render.lens import TOLERANCE
from ..render.types import Instance
from ..scene import Scene
from ..scene.spherical_harmonics import SH_C0
from .compose import instances_at
from .state import ScenarioState

Part = Literal["all", "background", "objects"]

ROW = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue", "semantic")),
        ("instance", "<u2"),
    ]
)
"""A point in the world [m]; its normal is the thinnest axis of its Gaussian."""

LEAST_OPACITY = 0.1
"""Fainter Gaussians are left out."""

_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort"}


def points_at(
    scene: Scene,
    state: ScenarioState,
    t_us: int,
    *,
    part: Part = "all",
    instance_id: int | None = None,
    least_opacity: float = LEAST_OPACITY,
) -> NDArray[np.void]:
    """Rows of ROW of a scenario at an instant.

    Normals point towards the recorded path, those of objects away from their centre.

    Args:
        scene: of the scenario.
        state: the scenario.
        t_us: instant [us].
        part: of the scene.
        instance_id: of the only object that is wanted; None for all.
        least_opacity: of a Gaussian that is a point.

    Raises:
        UnknownObjectError: ``state`` is of another scene.
    """
    shown = instances_at(scene, state, t_us)
    background, objects = shown[0], [i for i in shown[1:] if i.instance_id > 0]
    if instance_id is not None:
        objects = [i for i in objects if i.instance_id == instance_id]
    kept = [background] if part != "objects" and instance_id is None else []
    kept += objects if part != "background" else []
    rows = [_rows(scene, instance, least_opacity) for instance in kept]
    return np.concatenate(rows) if rows else np.zeros(0, ROW)


def ply_of_points(rows: NDArray[np.void]) -> Iterable[bytes]:
    """A binary ply file, in parts."""
    names = rows.dtype.names or ()
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property {_TYPES[rows.dtype[name].str]} {name}" for name in names]
    yield ("\n".join([*lines, "end_header"]) + "\n").encode()
    yield rows.tobytes()


def _rows(scene: Scene, instance: Instance, least_opacity: float) -> NDArray[np.void]:
    cloud = instance.cloud
    if instance.colour is not None:
        cloud = instance.colour.at(cloud, instance.t_us)
    seen = (cloud.opacities >= least_opacity).cpu().numpy()
    means = cloud.means.cpu().numpy()[seen].astype(np.float64)
    scale = np.asarray(instance.scale)
    scales = cloud.scales.cpu().numpy()[seen] * scale
    turns = quaternion_to_matrix(cloud.quats.cpu().numpy()[seen].astype(np.float64))
    thin = np.take_along_axis(turns, scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]
    points = means * scale
    placed = instance.T_world_object
    towards = _nearest(scene.ego.positions, points) if placed is None else 2 * points
    outward = towards - points
    thin[(thin * outward).sum(axis=1) < 0] *= -1
    if placed is not None:
        pose = np.asarray(placed, dtype=np.float64)
        points, thin = points @ pose[:3, :3].T + pose[:3, 3], thin @ pose[:3, :3].T
    rows = np.zeros(len(points), ROW)
    for k, axis in enumerate("xyz"):
        rows[axis], rows[f"n{axis}"] = points[:, k], thin[:, k]
    colours = np.clip(cloud.sh.cpu().numpy()[seen, 0] * SH_C0 + 0.5, 0, 1)
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = np.rint(colours[:, k] * 255)
    rows["instance"], rows["semantic"] = instance.instance_id, instance.semantic
    if instance.instance_id == 0:
        above = np.abs(points[:, 2] - scene.ground.height_at(points[:, :2]))
        rows["semantic"] = np.where(above < TOLERANCE, GROUND, STATIC)
    return rows


def _nearest(path: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The place on a path, raised to where sensors look from, that is nearest to each point."""
    from scipy.spatial import cKDTree

    raised = path + np.array([0.0, 0.0, 1.6])
    found: NDArray[np.float64] = raised[cKDTree(raised).query(points)[1]]
    return found
