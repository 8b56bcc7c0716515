"""Device memory of frames: cached clouds, tables of a request, work space and images."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene import GaussianCloud, Sky, TimeColour
from ..backend import CLAMP_MARGIN, RasterRequest, class_behind
from ..types import Instance, RasterOptions, RenderError
from .launcher import (
    CAMERA,
    COUNTERS,
    DIGITS,
    FRAME,
    IMAGES,
    OBJECT,
    PIECE,
    PLACEMENT,
    SPLAT_BYTES,
    TILE,
    WORDS,
    Launcher,
)


class DeviceScene:
    """Device addresses of clouds, colours and skies.

    Tensors on other devices are copied once, and cached for the lifetime of the original.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._held: weakref.WeakKeyDictionary[object, tuple[tuple[int, ...], list[Tensor]]] = (
            weakref.WeakKeyDictionary()
        )

    def cloud(self, cloud: GaussianCloud) -> tuple[int, ...]:
        """Addresses of means, quats, scales, opacities and sh; number of Gaussians, and of
        spherical harmonics coefficients per Gaussian."""
        held = self._held.get(cloud)
        if held is not None:
            return held[0]
        parts = (cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
        return self._hold(cloud, parts, (len(cloud), int(cloud.sh.shape[1])))

    def colour(self, colour: TimeColour) -> int:
        """Address of the coefficients."""
        return self._one(colour, colour.coefficients)

    def sky(self, sky: Sky) -> int:
        """Address of the faces."""
        return self._one(sky, sky.faces)

    def _one(self, owner: object, tensor: Tensor) -> int:
        held = self._held.get(owner)
        return (self._hold(owner, (tensor,), ()) if held is None else held[0])[0]

    def _hold(
        self, owner: object, parts: tuple[Tensor, ...], sizes: tuple[int, ...]
    ) -> tuple[int, ...]:
        moved = [part.detach().to(self._launcher.device).contiguous() for part in parts]
        numbers = (*(self._launcher.pointer(tensor) for tensor in moved), *sizes)
        self._held[owner] = (numbers, moved)
        return numbers


# Tables for the kernels: one pass over the requests, then array operations.

IDENTITY = np.eye(4)
CLOUD_COLUMNS = ("means", "quats", "scales", "opacities", "sh", "count", "functions")
"""Fields returned by DeviceScene.cloud."""


@dataclass(frozen=True, eq=False)
class Tables:
    """A frame of C cameras and I objects, each drawn by consecutive cameras.

    Attributes:
        objects: [I] OBJECT; the field ``tones`` is an index into ``tones``.
        placements: PLACEMENT of each pair of object and camera.
        cameras: [C] CAMERA.
        tones: [T] float32, basis functions of time-dependent colours.
        pieces, entries, tiles, pixels: totals of the frame.
        moved: tensors copied to the device only for this frame.
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
    """An instance and the range of cameras that draw it."""

    instance: Instance
    first_camera: int
    cameras: int


def tables_of(
    requests: Sequence[RasterRequest], device_scene: DeviceScene, launcher: Launcher
) -> Tables:
    """Tables of all cameras of ``requests``, in their order.

    Instances shared at the start of all requests, such as the background of sessions on one scene,
    are listed and processed once for all cameras.
    """
    drawn = _drawn(requests)
    viewmats = np.concatenate([request.viewmats.detach().cpu().numpy() for request in requests])
    cameras = _cameras(requests, viewmats, device_scene)
    objects, tones, moved = _objects(drawn, device_scene, launcher)
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
    """Instances and their cameras; instances shared by all requests come first."""
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
    """Length of the common prefix of two worlds."""
    if first is second:
        return len(first)
    pairs = zip(first, second, strict=False)
    return next(
        (k for k, (a, b) in enumerate(pairs) if not _is_same(a, b)), min(len(first), len(second))
    )


def _is_same(a: Instance, b: Instance) -> bool:
    """Whether two instances look the same, judged by host data alone."""
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
    requests: Sequence[RasterRequest], viewmats: NDArray[np.float64], device_scene: DeviceScene
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
    skies = [(device_scene.sky(r.sky), r.sky.resolution) if r.sky else (0, 0) for r in requests]
    table["sky"] = np.repeat(np.array([sky for sky, _ in skies], np.uint64), counts)
    table["sky_resolution"] = np.repeat([resolution for _, resolution in skies], counts)
    table["behind"] = np.repeat([class_behind(request) for request in requests], counts)
    table["width"], table["height"] = size[:, 0], size[:, 1]
    table["tiles_x"], table["tiles_y"] = (-(-size // TILE)).T
    table["first_tile"] = _sums_before(table["tiles_x"] * table["tiles_y"])
    table["first_pixel"] = _sums_before(table["width"] * table["height"])
    return table


def _objects(
    drawn: Sequence[_Drawn], device_scene: DeviceScene, launcher: Launcher
) -> tuple[NDArray[np.void], NDArray[np.float32], list[Tensor]]:
    """Table of objects, their tones, and the tensors copied for this frame."""
    table = np.zeros(len(drawn), OBJECT)
    if not drawn:
        return table, np.zeros(0, np.float32), []
    clouds = np.array([device_scene.cloud(item.instance.cloud) for item in drawn], np.uint64).T
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
            table["colour"][row] = device_scene.colour(colour)
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
    """Placements of objects relative to their cameras, computed in float64."""
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


# Memory of a frame: uploads, work space, images

ALIGNMENT = 256
REPORT_BYTES = COUNTERS * 4
SORT_BLOCKS = 512
"""Maximum number of blocks that sort a list."""
MAX_PAIRS = 1 << 31
PAIRS_PER_SPLAT = 4
"""Initial capacity for tiles per splat."""


@dataclass(frozen=True, eq=False)
class Images:
    """Device memory of a frame's images, after a report of REPORT_BYTES.

    Attributes:
        memory: [bytes] uint8 on the device.
        places: offset and size of each image [bytes].
    """

    memory: Tensor
    places: dict[str, tuple[int, int]]


class FrameMemory:
    """Work space for one frame at a time; grows on demand and is reused."""

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._spaces: dict[str, Tensor] = {}
        self._staged: Tensor = launcher.host_memory(0)
        self._counters = torch.zeros(COUNTERS, dtype=torch.int32, device=launcher.device)
        self.seen_capacity = 0
        self.pair_capacity = 0

    def reserve(self, seen: int, pairs: int) -> None:
        """Reserve memory for ``seen`` splats and ``pairs`` of splat and tile.

        Raises:
            RenderError: above the limits of a frame.
        """
        if pairs > MAX_PAIRS or seen > MAX_PAIRS:
            raise RenderError(
                f"a frame with {seen} splats on {pairs} tiles is more than the {MAX_PAIRS} that "
                "can be sorted at once; draw fewer cameras in a call, or smaller ones"
            )
        self.seen_capacity = max(self.seen_capacity, -(-seen // PIECE) * PIECE)
        self.pair_capacity = max(self.pair_capacity, -(-pairs // PIECE) * PIECE)

    @property
    def sort_blocks(self) -> int:
        """Number of blocks that sort a list."""
        return min(SORT_BLOCKS, max(1, self.pair_capacity // (4 * PIECE)))

    def images(self, names: Sequence[str], pixels: int) -> Images:
        """Allocate memory for images of all cameras."""
        places, used = {}, _aligned(REPORT_BYTES)
        for name in names:
            dtype, channels = IMAGES[name]
            nbytes = pixels * np.dtype(dtype).itemsize * int(np.prod(channels))
            places[name] = (used, nbytes)
            used += _aligned(nbytes)
        memory = torch.empty(used, dtype=torch.uint8, device=self._launcher.device)
        return Images(memory, places)

    def upload(self, tables: Tables, images: Images, options: RasterOptions) -> int:
        """Copy the tables and the Frame to the device in one copy; return the Frame's address."""
        parts = (tables.objects, tables.placements, tables.cameras, tables.tones)
        sizes = [FRAME.itemsize, *(part.nbytes for part in parts)]
        starts = [0, *np.cumsum([_aligned(size) for size in sizes]).tolist()]
        held = self._space("tables", starts[-1])
        base = self._launcher.pointer(held)
        tables.objects["tones"] = base + starts[4] + 4 * tables.objects["tones"]
        frame = np.zeros(1, FRAME)
        frame["objects"], frame["placements"], frame["cameras"] = (base + s for s in starts[1:4])
        self._fill(frame, tables, images, options)
        if len(self._staged) < starts[-1]:
            self._staged = self._launcher.host_memory(2 * starts[-1])
        staged = self._staged.numpy()
        for start, part in zip(starts, (frame, *parts), strict=False):
            staged[start : start + part.nbytes] = part.reshape(-1).view(np.uint8)
        held[: starts[-1]].copy_(self._staged[: starts[-1]], non_blocking=True)
        return base

    def _fill(
        self, frame: NDArray[np.void], tables: Tables, images: Images, options: RasterOptions
    ) -> None:
        seen, pairs = self.seen_capacity, self.pair_capacity
        sizes = {
            "seen_masks": tables.entries * WORDS * 4,
            "entry_starts": (tables.entries + 1) * 4,
            "splats": seen * SPLAT_BYTES,
            "boxes": seen * 8,
            **dict.fromkeys(("depths_0", "depths_1", "order_0", "order_1"), seen * 4),
            **dict.fromkeys(("tiles_0", "tiles_1", "members_0", "members_1"), pairs * 4),
            "pair_starts": (seen // PIECE + 1) * 4,
            "digit_counts": self.sort_blocks * DIGITS * 4,
            "digit_starts": DIGITS * 4,
            "tile_ranges": tables.tiles * 8,
        }
        for name, nbytes in sizes.items():
            frame[name] = self._launcher.pointer(self._space(name, nbytes))
        frame["counters"] = self._launcher.pointer(self._counters)
        output = self._launcher.pointer(images.memory)
        frame["report"] = output
        for name, (start, _) in images.places.items():
            frame[name] = output + start
        frame["object_count"], frame["camera_count"] = len(tables.objects), len(tables.cameras)
        frame["pieces"], frame["entries"] = tables.pieces, tables.entries
        frame["tile_count"], frame["tile_passes"] = tables.tiles, tile_passes(tables.tiles)
        frame["seen_capacity"], frame["pair_capacity"] = seen, pairs
        frame["sort_blocks"] = self.sort_blocks
        frame["antialiased"] = options.rasterize_mode == "antialiased"
        for name in ("near_plane", "far_plane", "eps2d", "radius_clip"):
            frame[name] = getattr(options, name)

    def _space(self, name: str, nbytes: int) -> Tensor:
        held = self._spaces.get(name)
        if held is None or len(held) < nbytes:
            self._spaces.pop(name, None)
            size = max(ALIGNMENT, nbytes)
            held = torch.empty(size, dtype=torch.uint8, device=self._launcher.device)
            self._spaces[name] = held
        return held


def tile_passes(tiles: int) -> int:
    """Number of 8-bit passes of the sort by tile."""
    return max(1, -(-(tiles - 1).bit_length() // 8))


def _aligned(nbytes: int) -> int:
    return -(-nbytes // ALIGNMENT) * ALIGNMENT
