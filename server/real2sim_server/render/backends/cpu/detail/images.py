"""Requests of small images, alone or many at once, on their way to the kernel that draws them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numba
import numpy as np
import torch
from numpy.typing import NDArray

from ....types import Instance, RasterOptions, RenderOutput, WorldViews
from ...base import RasterRequest
from ..inputs import Workspace, array_of, timed, view_of
from ..records import RECORD
from .draw import draw_images
from .hierarchy import Hierarchy, deformed_hierarchy, hierarchy_of
from .pointers import table_of

CELL_PIXELS = 2.5
"""Merged cells are at most this large on the image [px]. It takes a seventh less time than 2 and is
0.7 dB farther from a large image scaled down; 3 takes a fifth less, and is 1.4 dB farther."""
PIXEL_VARIANCE = 0.1
"""Blur of a pixel, little more than that of its own square (1/12) [px^2]. With the usual 0.3 and no
opacity taken back, Gaussians smaller than a pixel grow together: 8 dB farther from a large image
scaled down."""
NO_SKY = np.zeros((6, 0, 0, 3), np.float32)


class SmallImages:
    """Draws small images, one call at a time; keeps work space."""

    def __init__(self) -> None:
        self._space = Workspace()

    def draw(self, requests: Sequence[RasterRequest]) -> RenderOutput:
        """All images of the requests, which are of one size, one sky and the same options.

        Images are drawn side by side, each on one core; it says nothing of what others show.
        """
        timing: dict[str, float] = {}
        with timed(timing, "project"):
            draws = _draws(requests)
        with timed(timing, "blend"):
            return self._drawn(requests[0], draws, timing)

    def draw_worlds(self, worlds: WorldViews, like: RasterRequest) -> RenderOutput:
        """All images of worlds of the same things; sizes, sky and options are those of ``like``."""
        timing: dict[str, float] = {}
        with timed(timing, "project"):
            draws = _world_draws(worlds, like)
        with timed(timing, "blend"):
            return self._drawn(like, draws, timing)

    def _drawn(self, like: RasterRequest, draws: _Draws, timing: dict[str, float]) -> RenderOutput:
        options, images = like.options, len(draws.views)
        shape = (images, like.height, like.width)
        rgb, alpha = np.empty((*shape, 3), np.float32), np.empty(shape, np.float32)
        depth = np.empty(shape if options.depth else (1, 0, 0), np.float32)
        instance = np.empty(shape if options.instance else (1, 0, 0), np.uint16)
        median = np.empty(shape if options.median_depth else (1, 0, 0), np.float32)
        background = (0.0, 0.0, 0.0) if like.sky is not None else options.background
        draw_images(
            draws.table,
            draws.tones,
            draws.draws,
            draws.linear,
            draws.offset,
            draws.camera_position,
            draws.scale,
            draws.first_draws,
            draws.views,
            CELL_PIXELS,
            np.array(background, np.float32),
            NO_SKY if like.sky is None else array_of(like.sky.faces),
            draws.sky_matrices,
            self._work(min(numba.get_num_threads(), images), draws.gaussians),
            rgb,
            alpha,
            depth,
            instance,
            median,
        )
        return RenderOutput(
            rgb=torch.from_numpy(rgb),
            alpha=torch.from_numpy(alpha),
            depth=torch.from_numpy(depth) if options.depth else None,
            instance=torch.from_numpy(instance) if options.instance else None,
            timing_ms=timing,
            median_depth=torch.from_numpy(median) if options.median_depth else None,
        )

    def _work(self, slots: int, gaussians: int) -> tuple[NDArray[np.generic], ...]:
        array = self._space.array
        return (
            array("values", (slots, gaussians, RECORD), np.float32),
            array("footprints", (slots, gaussians), np.int64),
            array("depths", (slots, gaussians), np.float32),
            array("pairs", (2, slots, gaussians), np.uint64),
            array("chosen", (slots, gaussians), np.int64),
        )


@dataclass(frozen=True, eq=False)
class _Draws:
    """Arguments of draw_images; ``gaussians`` is how many an image may show at most.

    ``held`` keeps alive what the table points to.
    """

    held: Sequence[Hierarchy]
    table: NDArray[np.int64]
    tones: NDArray[np.float32]
    draws: NDArray[np.int64]
    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]
    first_draws: NDArray[np.int64]
    views: NDArray[np.float32]
    sky_matrices: NDArray[np.float32]
    gaussians: int


def _draws(requests: Sequence[RasterRequest]) -> _Draws:
    rows: dict[tuple[int, int, int], int] = {}
    tones_at: dict[tuple[int, int], NDArray[np.float32]] = {}
    held: list[Hierarchy] = []
    drawn: list[tuple[int, int]] = []
    poses: list[NDArray[np.float64]] = []
    scales: list[tuple[float, float, float]] = []
    coloured: list[tuple[int, NDArray[np.float32]]] = []
    firsts = [0]
    image_of: list[int] = []
    cameras: list[NDArray[np.float64]] = []
    views, sky_matrices = [], []
    gaussians = 1
    options = _filtered(requests[0].options)
    for given in requests:
        request = replace(given, options=options)
        viewmats = request.viewmats.detach().cpu().numpy()
        Ks = request.Ks.detach().cpu().numpy()
        for c in range(request.cameras):
            total = 0
            for instance in request.instances:
                if not len(instance.cloud):
                    continue
                key = (id(instance.cloud), id(instance.covars), id(instance.colour))
                row = rows.get(key)
                if row is None:
                    row = rows[key] = len(held)
                    held.append(_hierarchy(instance))
                if instance.colour is not None:
                    at = (id(instance.colour), instance.t_us)
                    if at not in tones_at:
                        tones_at[at] = array_of(instance.colour.tones(instance.t_us))
                    coloured.append((len(drawn), tones_at[at]))
                drawn.append((row, instance.instance_id))
                poses.append(_pose(instance))
                scales.append(instance.scale)
                image_of.append(len(cameras))
                total += len(instance.cloud)
            gaussians = max(gaussians, total)
            firsts.append(len(drawn))
            cameras.append(viewmats[c])
            views.append(tuple(view_of(request, c)))
            sky_matrices.append(viewmats[c][:3, :3].T @ np.linalg.inv(Ks[c]))
    T_camera_object = np.array(poses).reshape(-1, 4, 4)
    if poses:
        T_camera_object = np.array(cameras)[image_of] @ T_camera_object
    tones = np.zeros((len(drawn), max((len(t) for _, t in coloured), default=0)), np.float32)
    for index, values in coloured:
        tones[index, : len(values)] = values
    return _Draws(
        held=held,
        table=table_of(held),
        tones=tones,
        draws=np.array(drawn, np.int64).reshape(-1, 2),
        **_places(T_camera_object, np.array(scales, np.float64).reshape(-1, 3)),
        first_draws=np.array(firsts, np.int64),
        views=np.array(views, np.float32),
        sky_matrices=np.array(sky_matrices, np.float32),
        gaussians=gaussians,
    )


def _world_draws(worlds: WorldViews, like: RasterRequest) -> _Draws:
    """The same of worlds of the same things: one row of the table and one hierarchy each."""
    filled = np.array([len(thing.cloud) > 0 for thing in worlds.things], np.bool_)
    held = [_hierarchy(thing) for thing in worlds.things if len(thing.cloud)]
    rows = np.cumsum(filled) - 1
    cameras = len(worlds.Ks)
    shown = np.repeat(worlds.shown & filled, cameras, axis=0)
    image_of, thing_of = np.nonzero(shown)
    world_of = image_of // cameras
    viewmats = worlds.viewmats.reshape(-1, 4, 4)
    ids = np.array([thing.instance_id for thing in worlds.things], np.int64)
    scales = np.array([thing.scale for thing in worlds.things], np.float64).reshape(-1, 3)
    sizes = np.array([len(thing.cloud) for thing in worlds.things], np.int64)
    numbers = replace(like, Ks=torch.from_numpy(worlds.Ks), options=_filtered(like.options))
    views = np.array([tuple(view_of(numbers, c)) for c in range(cameras)], np.float32)
    inverse = np.linalg.inv(worlds.Ks)
    images = len(viewmats)
    return _Draws(
        held=held,
        table=table_of(held),
        tones=_tones(worlds, thing_of, worlds.times_us[world_of]),
        draws=np.stack([rows[thing_of], ids[thing_of]], axis=1),
        **_places(viewmats[image_of] @ worlds.poses[world_of, thing_of], scales[thing_of]),
        first_draws=np.append(0, np.cumsum(shown.sum(1))).astype(np.int64),
        views=np.tile(views, (images // cameras, 1)),
        sky_matrices=(
            viewmats[:, :3, :3].transpose(0, 2, 1) @ np.tile(inverse, (images // cameras, 1, 1))
        ).astype(np.float32),
        gaussians=max(1, int((shown @ sizes).max(initial=0))),
    )


def _tones(
    worlds: WorldViews, thing_of: NDArray[np.int64], times_us: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Of each draw [D, F]."""
    counts = [
        0 if thing.colour is None else int(thing.colour.coefficients.shape[1])
        for thing in worlds.things
    ]
    tones = np.zeros((len(thing_of), max(counts, default=0)), np.float32)
    for k, thing in enumerate(worlds.things):
        if thing.colour is None:
            continue
        own = thing_of == k
        tones[own, : counts[k]] = thing.colour.tones_of(times_us[own])
    return tones


class _Places(TypedDict):
    """Where draws stand before their cameras, see draw_images."""

    linear: NDArray[np.float64]
    offset: NDArray[np.float64]
    camera_position: NDArray[np.float32]
    scale: NDArray[np.float32]


def _places(T_camera_object: NDArray[np.float64], scale: NDArray[np.float64]) -> _Places:
    rotation, offset = T_camera_object[:, :3, :3], T_camera_object[:, :3, 3]
    position = -(rotation.transpose(0, 2, 1) @ offset[..., None])[..., 0]
    return {
        "linear": np.ascontiguousarray(rotation * scale[:, None, :]),
        "offset": np.ascontiguousarray(offset),
        "camera_position": position.astype(np.float32),
        "scale": scale.astype(np.float32),
    }


def _filtered(options: RasterOptions) -> RasterOptions:
    eps2d = min(options.eps2d, PIXEL_VARIANCE)
    return replace(options, eps2d=eps2d, rasterize_mode="antialiased")


def _hierarchy(instance: Instance) -> Hierarchy:
    if instance.covars is not None:
        return deformed_hierarchy(instance.cloud, instance.covars, instance.colour)
    return hierarchy_of(instance.cloud, instance.colour)


IDENTITY = np.eye(4)


def _pose(instance: Instance) -> NDArray[np.float64]:
    pose = instance.T_world_object
    if pose is None:
        return IDENTITY
    return pose.detach().cpu().numpy() if isinstance(pose, torch.Tensor) else np.asarray(pose)
