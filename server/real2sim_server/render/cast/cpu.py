"""cast() on the CPU: prepare records, sort, assign to tiles, trace rays."""

from __future__ import annotations

import threading

import numpy as np
from numpy.typing import NDArray

from ...geometry import Float, invert_transform
from .._cpu.blend import sort_records, tile_starts
from .._cpu.drawing import NO_COVARS, Workspace, array_of, arrays_of, timed
from .._cpu.records import CHUNK, Records
from .blend import follow_rays, list_hits
from .layout import (
    RECORD,
    TILE_CHUNKS,
    BeamLayout,
    Body,
    Lights,
    Sensor,
    count_rays,
    layout_of,
    scatter_rays,
)
from .prepare import prepare_body
from .types import CastRequest, Echo, Motion, RayHits, Return, motions_of

NO_ATTRIBUTES = np.zeros((0, 2), np.float32)
VALUES = 5


class CpuCaster:
    """cast() on the CPU. Calls are serialised across threads."""

    name = "cpu"

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._space = Workspace()

    def cast(self, request: CastRequest) -> Echo:
        """Trace all rays of the request."""
        timing: dict[str, float] = {}
        with self._lock:
            with timed(timing, "prepare"):
                records, regions, motions = self._prepare(request)
            layout = layout_of(request.lidar.beams)
            with timed(timing, "sort"):
                total = int(records.counts[:regions].sum())
                pairs = self._space.array("pairs", (total,), np.uint64)
                scratch = self._space.array("pairs_scratch", (total,), np.uint64)
                order = sort_records(records, regions, pairs, scratch)
            with timed(timing, "tile"):
                lists, starts = self._tile(records, order, layout)
            with timed(timing, "follow"):
                lights = _follow(request, motions, records, lists, starts, layout)
        return echo_of(request, lights, timing)

    def trace(self, request: CastRequest, reach: NDArray[np.float32]) -> RayHits:
        """Hits of the rays of a request, each up to its ``reach`` [R] [m].

        A reach of 0 follows the ray until its light is absorbed.
        """
        with self._lock:
            records, regions, motions = self._prepare(request)
            layout = layout_of(request.lidar.beams)
            total = int(records.counts[:regions].sum())
            pairs = self._space.array("pairs", (total,), np.uint64)
            scratch = self._space.array("pairs_scratch", (total,), np.uint64)
            order = sort_records(records, regions, pairs, scratch)
            lists, starts = self._tile(records, order, layout)
            counts = np.array([len(instance.cloud) for instance in request.instances] or [0])
            rays = request.lidar.beams.count
            begins = np.zeros(rays + 1, np.int64)
            none, no_shares = np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
            given = (
                records.values,
                lists,
                starts,
                layout,
                np.array(motions.of_body or [0], np.int64),
                rows_of(invert_transform(motions.to_sensor)),
                _limits(request),
                (np.cumsum(counts) - counts).astype(np.int64),
                np.ascontiguousarray(reach, dtype=np.float32),
            )
            list_hits(*given, begins, none, no_shares)
            begins = np.cumsum(begins) - begins
            members = np.empty(max(1, int(begins[-1])), np.int32)
            shares = np.empty((len(members), 2), np.float32)
            list_hits(*given, begins, members, shares)
        found = int(begins[-1])
        return RayHits(begins, members[:found], shares[:found, 0], shares[:found, 1])

    def _prepare(self, request: CastRequest) -> tuple[Records, int, Motion]:
        chunks = [-(-len(instance.cloud) // CHUNK) for instance in request.instances]
        total = 2 * sum(chunks)
        space = self._space
        records = Records(
            space.array("values", (total * CHUNK, RECORD), np.float32),
            space.array("footprints", (total * CHUNK,), np.int64),
            space.array("depths", (total * CHUNK,), np.float32),
            space.array("counts", (total,), np.int64),
        )
        motions = motions_of(request)
        layout, sensor = layout_of(request.lidar.beams), sensor_of(request)
        base = 0
        for index, count in enumerate(chunks):
            if count:
                body = _body(request, motions, index)
                prepare_body(body, sensor, layout, base, records)
            base += count
        return records, total, motions

    def _tile(
        self, records: Records, order: NDArray[np.uint64], layout: BeamLayout
    ) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        tiles = len(layout.rays)
        cursors = self._space.array("cursors", (TILE_CHUNKS, tiles), np.int64)
        ordered = self._space.array("ordered", order.shape, np.int64)
        starts = self._space.array("starts", (tiles + 1,), np.int64)
        count_rays(records.footprints, order, layout, ordered, cursors)
        tile_starts(cursors, 0, tiles, starts)
        lists = self._space.array("lists", (max(1, int(starts[tiles])),), np.int32)
        scatter_rays(ordered, order, layout, cursors, lists)
        return lists, starts


def sensor_of(request: CastRequest) -> Sensor:
    """The LiDAR of a request in kernel form."""
    lidar = request.lidar
    layout = layout_of(lidar.beams)
    times = lidar.beams.slots[0]
    numbers = {
        "near": lidar.min_range,
        "far": lidar.max_range,
        "wide": np.tan(lidar.divergence[0] / 2) / 2,
        "high": np.tan(lidar.divergence[1] / 2) / 2,
        "spread": layout.spread_us * 1e-6,
        "period": 1 / layout.rate if layout.rate > 0 else 0.0,
        "duration": (times[-1] - times[0]) * 1e-6,
    }
    return Sensor(**{name: np.float32(value) for name, value in numbers.items()})


def _body(request: CastRequest, motions: Motion, index: int) -> Body:
    instance, attributes = request.instances[index], request.attributes[index]
    means, quats, scales, opacities, _ = arrays_of(instance.cloud)
    motion = motions.of_body[index]
    return Body(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        covars=NO_COVARS if instance.covars is None else array_of(instance.covars),
        attributes=NO_ATTRIBUTES if attributes is None else attributes,
        linear=np.ascontiguousarray(motions.linear[index]),
        offset=np.ascontiguousarray(motions.offset[index]),
        frames=rows_of(motions.to_sensor[motion]),
        speed=np.float32(motions.speed[motion]),
        turn=np.float32(motions.turn[motion]),
        number=np.float32(index),
    )


def _limits(request: CastRequest) -> NDArray[np.float32]:
    lidar = request.lidar
    return np.array([lidar.min_range, lidar.max_range, lidar.pulse], np.float32)


def rows_of(transforms: Float) -> NDArray[np.float32]:
    """[..., 4, 4] as [..., 12] float32."""
    rows = transforms[..., :3, :].reshape(*transforms.shape[:-2], 12)
    return np.ascontiguousarray(rows, dtype=np.float32)


def _follow(  # noqa: PLR0917
    request: CastRequest,
    motions: Motion,
    records: Records,
    lists: NDArray[np.int32],
    starts: NDArray[np.int64],
    layout: BeamLayout,
) -> Lights:
    lidar = request.lidar
    count = lidar.beams.count
    lights = Lights(
        np.empty((count, VALUES), np.float32),
        np.empty((count, 2), np.int32),
        np.empty((count if lidar.returns > 1 else 0, 9), np.float32),
    )
    origins = rows_of(invert_transform(motions.to_sensor))
    limits = _limits(request)
    of_body = np.array(motions.of_body or [0], np.int64)
    follow_rays(
        records.values, lists, starts, layout, of_body, origins, limits, lidar.returns, lights
    )
    return lights


def echo_of(request: CastRequest, lights: Lights, timing: dict[str, float]) -> Echo:
    """Lights in the order of the sensor's rays, with external instance ids and members."""
    shape = request.lidar.shape
    values = np.ascontiguousarray(lights.values.T).reshape(VALUES, *shape)
    body, member = lights.owners[:, 0], lights.owners[:, 1]
    counts = np.array([len(instance.cloud) for instance in request.instances] or [0])
    firsts = np.cumsum(counts) - counts
    ids = np.array([instance.instance_id for instance in request.instances] or [0], np.uint16)
    met = body >= 0
    owner = np.maximum(body, 0)
    returns = {}
    if len(lights.returns):
        several = np.ascontiguousarray(lights.returns.T).reshape(3, 3, *shape)
        names = ("first", "strongest", "last")
        chosen = names if request.lidar.returns > 2 else ("first", "last")
        returns = {name: Return(*several[names.index(name)]) for name in chosen}
    return Echo(
        range=values[0],
        expected=values[1],
        opacity=values[2],
        intensity=values[3],
        drop=values[4],
        instance=np.where(met, ids[owner], 0).astype(np.uint16).reshape(shape),
        member=np.where(met, firsts[owner] + member, -1).astype(np.int32).reshape(shape),
        returns=returns,
        timing_ms=timing,
    )
