"""Drawing a camera with a lens or a rolling shutter: as a pinhole, with rays in place of the conic.

Nothing here is compiled before such a camera is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...lens_view import LensTables, LensView, tables_of
from ...types import Instance, RenderError, Sky
from ..base import Placement, RasterRequest
from .cull import Chunks, bounds_of
from .drawing import Drawing
from .inputs import Workspace, array_of, cluster_of, places_of, timed
from .project_lanes import REACH_MAX
from .ray_blend import blend_ray_tiles
from .ray_project import project_rays
from .ray_records import RAY_RECORD, RayParameters
from .ray_sky import add_ray_sky
from .records import CHUNK, TILE, Images, Records

MARGIN = np.radians(2.0)
"""By which the field of view is widened when chunks are left out."""
NO_LINES = np.zeros(0, np.float32)


def draw_rays(
    request: RasterRequest,
    placement: Placement,
    images: Images,
    space: Workspace,
    timing: dict[str, float],
) -> None:
    """Draw the one camera of a request that has optics.

    Args:
        request: with ``optics``.
        placement: of its instances before the camera in the middle of the read-out.
        images: to draw into.
        space: to work in.
        timing: gets milliseconds by stage.
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
    """A drawing by rays.

    Attributes:
        optics: the camera and its motion.
        rays: [H, W, 3] float32, see LensView.
        tables: of the camera.
    """

    optics: LensView
    rays: NDArray[np.float32]
    tables: LensTables

    @property
    def _widest(self) -> float:
        """Angle from the axis beyond which nothing is seen, with room for blur [rad]."""
        return min(self.tables.reach + float(MARGIN), float(np.pi))

    def seen_chunks(self, placement: Placement) -> list[Chunks]:
        """Numbers of the chunks of each instance that come near the field of view."""
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
        """Camera and options as the kernels take them."""
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
    """[2, 3] way and rotation vector of an instance over the read-out, in the camera's frame."""
    if instance.twist is None or not optics.moves:
        return np.zeros((2, 3))
    turn = optics.middle[:3, :3]
    return np.ascontiguousarray(instance.twist.reshape(2, 3) @ turn * optics.seconds)
