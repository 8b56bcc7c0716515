"""Drawing of cameras with a lens or a rolling shutter, with rays instead of conics.

The kernels are compiled when the first such camera is drawn. The inner loop is explicit vector code
over eight pixels. Their state is RAY_PLANES vectors: those of the pinhole, then the ray x, y, z and
its time, -0.5 to 0.5 over the readout.
"""

# Kernels take arrays by position: Numba supports neither dataclasses nor keyword-only arguments.
# ruff: noqa: PLR0917

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from ..._numba import PARALLEL_LOOPS
from ..backend import Placement, RasterRequest
from ..lens import LensTables, LensView, tables_of
from ..types import Instance, RenderError, Sky
from .blend import HALVES, LOOK_AHEAD, PLANES, TASKS, blend_exponent, touched_halves
from .drawing import Chunks, Drawing, Workspace, array_of, bounds_of, cluster_of, places_of, timed
from .lanes import FLOAT, I64, LANES, Lanes, Planes, inlined, kernel, lowest_bit, prefetch, splat
from .project import REACH_MAX
from .ray_project import project_rays
from .records import (
    BLUE,
    CHUNK,
    DEPTH,
    DRIFT,
    EXPONENT_LIMIT,
    EXPONENT_UNIT,
    FALLOFF,
    FRAME,
    GREEN,
    INSTANCE,
    LEVEL,
    MEAN_X,
    MEAN_Y,
    ORIGIN,
    RAY_RECORD,
    RED,
    SHARPNESS,
    SLOPE,
    SQUARE,
    TILE,
    WHITENING,
    Images,
    RayParameters,
    Records,
)
from .sky import add_ray_sky

RAY = PLANES
TIME = PLANES + 3
RAY_PLANES = PLANES + 4
VALUES = (RED, GREEN, BLUE, DEPTH, INSTANCE)


def _still_exponent(state: Planes, record: _Record) -> Lanes:
    """Emit the exponents of eight rays from one point; NaN or above the limit behind it.

    In the space where the Gaussian is a unit sphere with its centre at distance D on the third
    axis, a ray along (a, b, c) has the squared distance D^2 (a^2 + b^2) / (a^2 + b^2 + c^2) from
    it.
    """
    x, y, z = (state.load(RAY + k) for k in range(3))
    rows = [[record.number(FRAME + 3 * row + k) for k in range(3)] for row in range(3)]
    a, b, c = (x.fused(row[0], y.fused(row[1], z * row[2])) for row in rows)
    beside = a.fused(a, b * b)
    share = beside / c.fused(c, beside)
    exponent = share.fused(record.number(SQUARE), record.number(LEVEL))
    return exponent.where(c.compare(">", 0.0), 2 * EXPONENT_LIMIT)


def _moving_exponent(state: Planes, record: _Record) -> Lanes:
    """Emit the exponents of eight rays from different points.

    In the space where the Gaussian is a unit sphere about 0, a ray from o along d has the distance
    |o x d| / |d| from it. The cross product stays precise where |o|^2 - (o d)^2 / |d|^2 cancels.
    """
    x, y, z, time = (state.load(RAY + k) for k in range(4))
    w = [record.number(WHITENING + k) for k in range(6)]
    dx = x * w[0]
    dy = x.fused(w[1], y * w[2])
    dz = x.fused(w[3], y.fused(w[4], z * w[5]))
    ox, oy, oz = (time.fused(record.number(DRIFT + k), record.number(ORIGIN + k)) for k in range(3))
    cx = oy.fused(dz, -(oz * dy))
    cy = oz.fused(dx, -(ox * dz))
    cz = ox.fused(dy, -(oy * dx))
    beside = cx.fused(cx, cy.fused(cy, cz * cz))
    length = dx.fused(dx, dy.fused(dy, dz * dz))
    towards = ox.fused(dx, oy.fused(dy, oz * dz))
    exponent = (beside / length).fused(0.5 / EXPONENT_UNIT, record.number(LEVEL))
    return exponent.where(towards.compare("<", 0.0), 2 * EXPONENT_LIMIT)


class _Record:
    """A record in memory; numbers are broadcast to all lanes."""

    def __init__(self, builder: ir.IRBuilder, data: Any) -> None:
        self._builder, self._data = builder, data

    def number(self, field: int) -> Lanes:
        """Value of a field."""
        place = self._builder.gep(self._data, [I64(field)], source_etype=FLOAT)
        return splat(self._builder, self._builder.load(place, typ=FLOAT))


def _ray_intrinsic(extras: int, *, moving: bool) -> Any:
    """Like :func:`.blend._blend_intrinsic`, for rays from one point or (``moving``) from many.

    In kernels: blend(pixels, half, record); returns 0 when all pixels are finished.
    """

    def blend(typingctx, pixels, half, record):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            state = Planes(builder, array.data, arguments[1], planes=RAY_PLANES)
            row = context.make_array(signature.args[2])(context, builder, arguments[2])
            numbers = _Record(builder, row.data)
            exponent = (_moving_exponent if moving else _still_exponent)(state, numbers)
            values = [numbers.number(field) for field in VALUES]
            return blend_exponent(builder, state, exponent, values, extras)

        return types.int64(pixels, types.int64, record), generate

    return intrinsic(blend)


blend_ray = _ray_intrinsic(1, moving=False)
blend_ray_all = _ray_intrinsic(7, moving=False)
blend_moving_ray = _ray_intrinsic(1, moving=True)
blend_moving_ray_all = _ray_intrinsic(7, moving=True)


# Blending of tiles by rays; otherwise like :mod:`.blend`


F32 = np.float32
HALF = F32(0.5)


@kernel(parallel=PARALLEL_LOOPS)
def blend_ray_tiles(
    values, lists, starts, tiles_x, first_tile, last_tile, background, rays, lines, by_row, images
):
    """Blend tiles [first_tile, last_tile) into Images.

    Args:
        values: [M, RAY_RECORD] float32.
        lists, starts, tiles_x, background: as in :func:`.blend.blend_tiles`.
        rays: [H, W, 3] float32, 0 outside the lens.
        lines: [H or W] float32, time of each row or column; [0] for a global shutter.
        by_row: whether ``lines`` has rows.
    """
    # Arrays written in a prange must be plain variables: writes through a NamedTuple are lost.
    rgb, alpha, depth, instance = images.rgb, images.alpha, images.depth, images.instance
    median = images.median
    everything = instance.shape[0] > 0 or median.shape[0] > 0
    kind = (1 if everything else 0) + (2 if lines.shape[0] > 0 else 0)
    halves_of = values.reshape(2 * values.shape[0], values.shape[1] // 2)
    for task in prange(TASKS):
        pixels = np.empty(TILE * HALVES * RAY_PLANES * LANES, np.float32)
        for tile in range(first_tile + task, last_tile, TASKS):
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            going = open_ray_tile(pixels, x0, y0, rays, lines, by_row)
            first, last = starts[tile], starts[tile + 1]
            blend_ray_tile(
                values, halves_of, lists, first, last, F32(x0), F32(y0), pixels, going, kind
            )
            write_ray_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median)


@inlined()
def open_ray_tile(pixels, x0, y0, rays, lines, by_row):
    """Like :func:`.blend.open_tile`; also finishes pixels outside the lens."""
    pixels[:] = 0
    alive = np.int64(0)
    for row in range(min(TILE, rays.shape[0] - y0)):
        for column in range(min(TILE, rays.shape[1] - x0)):
            half = column // LANES * TILE + row
            p = half * RAY_PLANES * LANES + column % LANES
            ray = rays[y0 + row, x0 + column]
            seen = ray[0] != 0 or ray[1] != 0 or ray[2] != 0
            pixels[p] = F32(1) if seen else F32(-1)
            for k in range(3):
                pixels[p + (RAY + k) * LANES] = ray[k]
            if lines.shape[0] > 0:
                pixels[p + TIME * LANES] = lines[y0 + row if by_row else x0 + column]
            if seen:
                alive |= np.int64(1) << half
    return alive


@inlined()
def blend_ray_tile(values, halves_of, lists, first, last, x0, y0, pixels, alive, kind):
    """Blend lists[first:last], near to far, until all pixels are finished."""
    for position in range(first, last):
        ahead = np.int64(lists[min(position + LOOK_AHEAD, last - 1)])
        prefetch(halves_of, 2 * ahead)
        prefetch(halves_of, 2 * ahead + 1)
        record = values[lists[position]]
        x, y = x0 + HALF - record[MEAN_X], y0 + HALF - record[MEAN_Y]
        touched = touched_halves(
            x, y, record[SHARPNESS], record[SLOPE], record[FALLOFF], record[LEVEL]
        )
        touched &= alive
        while touched != 0:
            half = lowest_bit(touched)
            touched &= touched - 1
            going = blend_half_of_rays(pixels, half, record, kind)
            alive &= ~(np.int64(going == 0) << half)
        if alive == 0:
            break


@inlined()
def blend_half_of_rays(pixels, half, record, kind):
    """Blend one record over eight pixels; returns 0 when all of them are finished."""
    if kind == 0:
        return blend_ray(pixels, half, record)
    if kind == 1:
        return blend_ray_all(pixels, half, record)
    if kind == 2:
        return blend_moving_ray(pixels, half, record)
    return blend_moving_ray_all(pixels, half, record)


@inlined()
def write_ray_tile(pixels, x0, y0, background, rgb, alpha, depth, instance, median):
    """Composite the tile over the background and write it; black outside the lens."""
    height, width = alpha.shape
    for row in range(min(TILE, height - y0)):
        for column in range(min(TILE, width - x0)):
            p = (column // LANES * TILE + row) * RAY_PLANES * LANES + column % LANES
            y, x = y0 + row, x0 + column
            left = abs(pixels[p])
            total = F32(1) - left
            # A pixel finished before drawing is outside the lens and shows no background.
            left = F32(0) if pixels[p] == F32(-1) else left
            alpha[y, x] = total
            for channel in range(3):
                seen = pixels[p + (1 + channel) * LANES]
                rgb[y, x, channel] = seen + left * background[channel]
            if depth.shape[0]:
                depth[y, x] = pixels[p + 4 * LANES] / total if total > 0 else F32(0)
            if instance.shape[0]:
                instance[y, x] = np.uint16(pixels[p + 5 * LANES])
            if median.shape[0]:
                median[y, x] = pixels[p + 6 * LANES]


# Drawing

MARGIN = np.radians(2.0)
"""Margin of the field of view for culling chunks [rad]."""
NO_LINES = np.zeros(0, np.float32)


def draw_rays(
    request: RasterRequest,
    placement: Placement,
    images: Images,
    space: Workspace,
    timing: dict[str, float],
) -> None:
    """Draw the camera of a request with optics.

    Args:
        request: request with ``optics``.
        placement: placement of its instances relative to the camera at mid-readout.
        images: output images.
        space: work space.
        timing: receives milliseconds by stage.
    """
    optics = request.optics
    if optics is None:
        raise RenderError("a request without optics has no rays")
    with timed(timing, "project"):
        drawing = RayDrawing(
            request,
            0,
            images,
            space,
            timing,
            optics=optics,
            rays=optics.rays(),
            tables=tables_of(optics.camera),
        )
        chunks = drawing.seen_chunks(placement)
    drawing.draw(placement, chunks)


@dataclass(frozen=True, eq=False)
class RayDrawing(Drawing):
    """A Drawing by rays.

    Attributes:
        optics: the camera and its motion.
        rays: [H, W, 3] float32, see LensView.
        tables: lens tables of the camera.
    """

    optics: LensView
    rays: NDArray[np.float32]
    tables: LensTables

    @property
    def _widest(self) -> float:
        """Largest angle of a ray from the axis, including MARGIN [rad]."""
        return min(self.tables.reach + float(MARGIN), float(np.pi))

    def seen_chunks(self, placement: Placement) -> list[Chunks]:
        """Indices of the chunks of each instance near the field of view."""
        reach = self._widest
        way = float(np.linalg.norm(self.optics.shift))
        turn = float(np.linalg.norm(self.optics.turn))
        found = []
        for index, instance in enumerate(self.request.instances):
            bounds = bounds_of(instance.cloud)
            linear = placement.linear[0, index].numpy()
            centres = bounds.centres @ linear.T + placement.offset[0, index].numpy()
            scale = float(placement.scale[index].max())
            radius = scale * (np.linalg.norm(bounds.halves, axis=1) + REACH_MAX * bounds.sigmas)
            moved = np.abs(_drift(instance, self.optics)).sum(1)
            radius += way + moved[0] + moved[1] * (radius + np.linalg.norm(centres, axis=1))
            distance = np.linalg.norm(centres, axis=1)
            angle = np.arctan2(np.hypot(centres[:, 0], centres[:, 1]), centres[:, 2])
            half = np.arcsin(np.clip(radius / np.maximum(distance, 1e-9), 0, 1))
            near = (distance <= radius) | (angle - half <= reach + turn)
            if instance.covars is not None:
                near[:] = True
            found.append(np.flatnonzero(near))
        return found

    def _project(self, placement: Placement, chunks: Sequence[Chunks]) -> tuple[Records, int]:
        total = sum(map(len, chunks))
        records = Records(
            self.space.array("ray_values", (total * CHUNK, RAY_RECORD), np.float32),
            self.space.array("footprints", (total * CHUNK,), np.int64),
            self.space.array("depths", (total * CHUNK,), np.float32),
            self.space.array("counts", (total,), np.int64),
        )
        view, places = self._view(), places_of(placement, 0)
        base = 0
        for index, instance in enumerate(self.request.instances):
            if len(chunks[index]):
                cluster = cluster_of(instance, places, index)
                own = view._replace(drift=_drift(instance, self.optics))
                project_rays(cluster, own, base * CHUNK, chunks[index], records)
            base += len(chunks[index])
        return records, total

    def _view(self) -> RayParameters:
        """Camera and options as kernel input."""
        request, options, optics = self.request, self.request.options, self.optics
        tables, blur = self.tables, float(np.sqrt(options.eps2d))
        return RayParameters(
            width=np.float32(request.width),
            height=np.float32(request.height),
            near_plane=np.float32(options.near_plane),
            far_plane=np.float32(options.far_plane),
            eps2d=np.float32(options.eps2d),
            radius_clip=np.float32(options.radius_clip),
            antialiased=np.float32(options.rasterize_mode == "antialiased"),
            ranges=np.float32(optics.camera.shows_ranges),
            rolls=optics.moves,
            bend=np.float32(tables.bend),
            slack=np.float32(tables.slack),
            edge=np.float32(REACH_MAX * blur + 2.0),
            cosine=np.float32(np.cos(self._widest)),
            sine=np.float32(np.sin(self._widest)),
            turned=np.float32(np.linalg.norm(optics.turn)),
            directory=tables.directory,
            line=_line(optics),
            shift=np.ascontiguousarray(optics.shift),
            turn=np.ascontiguousarray(optics.turn),
            drift=np.zeros((2, 3)),
        )

    def _blend_tiles(
        self,
        records: Records,
        lists: NDArray[np.int32],
        starts: NDArray[np.int64],
        tiles: tuple[int, int],
        behind: NDArray[np.float32],
    ) -> None:
        lines = self.optics.lines().astype(np.float32) if self.optics.moves else NO_LINES
        blend_ray_tiles(
            records.values,
            lists,
            starts,
            -(-self.request.width // TILE),
            *tiles,
            behind,
            self.rays,
            lines,
            self.optics.camera.shutter.by_row,
            self.images,
        )

    def _add_sky(self, sky: Sky) -> None:
        turn = np.ascontiguousarray(self.optics.middle[:3, :3], np.float32)
        step = self._rows(1)
        for first in range(0, self.request.height, step):
            self._pause()
            rows = slice(first, first + step)
            with timed(self.timing, "sky"):
                rgb, alpha = self.images.rgb[rows], self.images.alpha[rows]
                add_ray_sky(array_of(sky.faces), turn, self.rays[rows], rgb, alpha)


def _line(optics: LensView) -> NDArray[np.float32]:
    """``line`` of RayParameters."""
    shutter = optics.camera.shutter
    lines = optics.camera.height if shutter.by_row else optics.camera.width
    step = 1 / max(lines - 1, 1)
    if shutter.direction not in {"top_to_bottom", "left_to_right"}:
        step = -step
    start = -0.5 * step - (0.5 if step > 0 else -0.5)
    return np.array([0, step, start] if shutter.by_row else [step, 0, start], np.float32)


def _drift(instance: Instance, optics: LensView) -> NDArray[np.float64]:
    """[2, 3] displacement [m] and rotation vector [rad] of an instance over the readout, in the
    camera frame."""
    if instance.twist is None or not optics.moves:
        return np.zeros((2, 3))
    turn = optics.middle[:3, :3]
    return np.ascontiguousarray(instance.twist.reshape(2, 3) @ turn * optics.seconds)
