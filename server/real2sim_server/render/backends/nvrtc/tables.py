"""From requests to the tables that the kernels read. One pass over the list, the rest is arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...types import Instance
from ..base import CLAMP_MARGIN, RasterRequest, class_behind
from .launcher import Launcher
from .records import CAMERA, OBJECT, PIECE, PLACEMENT, TILE
from .residence import Residence

IDENTITY = np.eye(4)
CLOUD_COLUMNS = ("means", "quats", "scales", "opacities", "sh", "count", "functions")
"""What Residence.cloud gives."""


@dataclass(frozen=True, eq=False)
class Tables:
    """A frame of C cameras and I objects, each drawn by cameras that follow one another.

    Attributes:
        objects: [I] OBJECT; ``tones`` are places in the array of that name.
        placements: one for each object and camera, PLACEMENT.
        cameras: [C] CAMERA.
        tones: [T] float32, basis functions of colours that change over time.
        pieces, entries, tiles, pixels: of the whole frame.
        moved: tensors that were copied to the device for this frame alone.
    """

    objects: NDArray[np.void]
    placements: NDArray[np.void]
    cameras: NDArray[np.void]
    tones: NDArray[np.float32]
    pieces: int
    entries: int
    tiles: int
    pixels: int
    moved: list[Tensor]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """An instance, and the cameras that draw it."""

    instance: Instance
    first_camera: int
    cameras: int


def tables_of(
    requests: Sequence[RasterRequest], residence: Residence, launcher: Launcher
) -> Tables:
    """Tables of all cameras of ``requests``, in their order.

    Instances with which all requests begin, such as the background of sessions on one scene, are
    listed once and looked at once for all cameras.
    """
    drawn = _drawn(requests)
    viewmats = np.concatenate([request.viewmats.detach().cpu().numpy() for request in requests])
    cameras = _cameras(requests, viewmats, residence)
    objects, tones, moved = _objects(drawn, residence, launcher)
    last = objects[-1] if len(objects) else None
    pixels = cameras["width"][-1].astype(np.int64) * cameras["height"][-1]
    return Tables(
        objects=objects,
        placements=_placements(drawn, objects, viewmats),
        cameras=cameras,
        tones=tones,
        pieces=0 if last is None else int(last["first_piece"]) + -(-int(last["count"]) // PIECE),
        entries=0
        if last is None
        else int(last["first_entry"]) + -(-int(last["count"]) // PIECE) * int(last["cameras"]),
        tiles=int(cameras["first_tile"][-1] + cameras["tiles_x"][-1] * cameras["tiles_y"][-1]),
        pixels=int(cameras["first_pixel"][-1] + pixels),
        moved=moved,
    )


def _drawn(requests: Sequence[RasterRequest]) -> list[_Drawn]:
    """Instances and their cameras, those that all requests begin with first."""
    first, others = requests[0].instances, requests[1:]
    total = sum(request.cameras for request in requests)
    shared = min((_shared(first, request.instances) for request in others), default=len(first))
    listed = [_Drawn(instance, 0, total) for instance in first[:shared]]
    camera = 0
    for request in requests:
        listed += [_Drawn(i, camera, request.cameras) for i in request.instances[shared:]]
        camera += request.cameras
    return listed


def _shared(first: Sequence[Instance], second: Sequence[Instance]) -> int:
    """How many instances two worlds have in common before they part."""
    if first is second:
        return len(first)
    pairs = zip(first, second, strict=False)
    return next(
        (k for k, (a, b) in enumerate(pairs) if not _is_same(a, b)), min(len(first), len(second))
    )


def _is_same(a: Instance, b: Instance) -> bool:
    """Whether two instances look the same, as far as that can be told on the host."""
    if a is b:
        return True
    timeless = a.colour is b.colour and (a.colour is None or a.t_us == b.t_us)
    ids = a.instance_id == b.instance_id and a.semantic == b.semantic
    plain = a.covars is b.covars and a.scale == b.scale and ids
    return a.cloud is b.cloud and timeless and plain and _is_same_pose(a, b)


def _is_same_pose(a: Instance, b: Instance) -> bool:
    here, there = a.T_world_object, b.T_world_object
    if isinstance(here, np.ndarray) and isinstance(there, np.ndarray):
        return np.array_equal(here, there)
    return here is there


def _cameras(
    requests: Sequence[RasterRequest], viewmats: NDArray[np.float64], residence: Residence
) -> NDArray[np.void]:
    counts = [request.cameras for request in requests]
    table = np.zeros(sum(counts), CAMERA)
    Ks = np.concatenate([request.Ks.detach().cpu().numpy() for request in requests])
    size = np.repeat([(r.width, r.height) for r in requests], counts, axis=0)
    focal, centre = Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2]
    margin = CLAMP_MARGIN * 0.5 * size / focal
    table["focal"], table["centre"] = focal, centre
    table["lowest"] = -centre / focal - margin
    table["highest"] = (size - centre) / focal + margin
    table["directions"] = viewmats[:, :3, :3].transpose(0, 2, 1) @ np.linalg.inv(Ks)
    table["background"] = np.repeat([r.options.background for r in requests], counts, axis=0)
    skies = [(residence.sky(r.sky), r.sky.resolution) if r.sky else (0, 0) for r in requests]
    table["sky"] = np.repeat(np.array([sky for sky, _ in skies], np.uint64), counts)
    table["sky_resolution"] = np.repeat([resolution for _, resolution in skies], counts)
    table["behind"] = np.repeat([class_behind(request) for request in requests], counts)
    table["width"], table["height"] = size[:, 0], size[:, 1]
    table["tiles_x"], table["tiles_y"] = (-(-size // TILE)).T
    table["first_tile"] = _sums_before(table["tiles_x"] * table["tiles_y"])
    table["first_pixel"] = _sums_before(table["width"] * table["height"])
    return table


def _objects(
    drawn: Sequence[_Drawn], residence: Residence, launcher: Launcher
) -> tuple[NDArray[np.void], NDArray[np.float32], list[Tensor]]:
    """Table of objects, the tones of their colours, and what was moved for this frame."""
    table = np.zeros(len(drawn), OBJECT)
    if not drawn:
        return table, np.zeros(0, np.float32), []
    clouds = np.array([residence.cloud(item.instance.cloud) for item in drawn], np.uint64).T
    for name, column in zip(CLOUD_COLUMNS, clouds, strict=True):
        table[name] = column
    table["first_camera"] = [item.first_camera for item in drawn]
    table["cameras"] = [item.cameras for item in drawn]
    table["scale"] = [item.instance.scale for item in drawn]
    table["instance"] = [item.instance.instance_id for item in drawn]
    table["semantic"] = [item.instance.semantic for item in drawn]
    moved: list[Tensor] = []
    tones: list[NDArray[np.float32]] = []
    for row, item in enumerate(drawn):
        covars, colour = item.instance.covars, item.instance.colour
        if covars is not None:
            moved.append(covars.detach().to(launcher.device).contiguous())
            table["covars"][row] = launcher.pointer(moved[-1])
        if colour is not None:
            table["colour"][row] = residence.colour(colour)
            table["tones"][row] = sum(map(len, tones))
            tones.append(colour.tones(item.instance.t_us).numpy())
            table["tone_count"][row] = len(tones[-1])
    pieces = -(-table["count"].astype(np.int64) // PIECE)
    table["first_piece"] = _sums_before(pieces)
    table["first_entry"] = _sums_before(pieces * table["cameras"])
    table["first_placement"] = _sums_before(table["cameras"])
    return table, np.concatenate([*tones, np.zeros(0, np.float32)]), moved


def _placements(
    drawn: Sequence[_Drawn], objects: NDArray[np.void], viewmats: NDArray[np.float64]
) -> NDArray[np.void]:
    """Where objects stand before their cameras, worked out in float64."""
    counts = objects["cameras"].astype(np.int64)
    table = np.zeros(int(counts.sum()), PLACEMENT)
    if not len(table):
        return table
    poses = np.stack([_pose(item.instance.T_world_object) for item in drawn])
    scales = np.array([item.instance.scale for item in drawn], np.float64)
    of_object = np.repeat(np.arange(len(drawn)), counts)
    turn = np.arange(len(table)) - np.repeat(_sums_before(counts), counts)
    of_camera = np.repeat(objects["first_camera"].astype(np.int64), counts) + turn
    T_camera_object = viewmats[of_camera] @ poses[of_object]
    rotation, offset = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    scale = scales[of_object]
    linear = rotation * scale[:, None, :]
    eye = -(rotation.transpose(0, 2, 1) @ offset[..., None])[..., 0] / scale
    table["depth_row"][:, :3], table["depth_row"][:, 3] = linear[:, 2], offset[:, 2]
    table["linear"] = linear
    table["eye"] = eye
    table["eye_rest"] = eye - table["eye"].astype(np.float64)
    return table


def _pose(T_world_object: NDArray[np.float64] | Tensor | None) -> NDArray[np.float64]:
    if T_world_object is None:
        return IDENTITY
    if isinstance(T_world_object, Tensor):
        return T_world_object.detach().cpu().to(torch.float64).numpy()
    return np.asarray(T_world_object, np.float64)


def _sums_before(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    counts = counts.astype(np.int64)
    sums: NDArray[np.int64] = np.cumsum(counts) - counts
    return sums
