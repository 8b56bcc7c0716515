"""cast() on an NVIDIA GPU: prepare records, assign to tiles, sort, trace rays.

Work space grows to the largest sweep so far. Clouds and sensor tables are copied to the device once
and cached for their lifetime. NVRTC compiles ``kernels/``; the NumPy types mirror the structures of
``kernels/beams.h`` field by field.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..._nvrtc import KernelSource
from ...geometry import invert_transform
from ...scene import Beams, GaussianCloud
from .._cuda.launcher import CudaLauncher, Launcher, Usage, usage_of
from ..types import RenderError
from .cpu import echo_of, rows_of, sensor_of
from .layout import BeamLayout, Lights, layout_of
from .types import CastRequest, Echo, Motion, motions_of

THREADS = 256
TILES_OF_BLOCK = 4
MET_BYTES = 64

_POINTER, _FLOAT, _COUNT = np.uint64, np.float32, np.uint32

TABLES = (
    *("rays", "directions", "slots", "lows", "highs", "sides", "band_starts"),
    *("tile_lows", "tile_highs", "first_tiles", "first_bands", "last_bands"),
    *("rows_before", "rows_until", "slot_of"),
)
"""Arrays of a BeamLayout that are copied to the device."""
BODY = np.dtype(
    [
        *(
            (name, _POINTER)
            for name in ("means", "quats", "scales", "opacities", "covars", "attributes")
        ),
        ("linear", np.float64, (9,)),
        ("offset", np.float64, (3,)),
        *((name, _COUNT) for name in ("first", "count", "motion", "unused")),
        ("speed", _FLOAT),
        ("turn", _FLOAT),
    ]
)
SWEEP = np.dtype(
    [
        *((name, _POINTER) for name in ("bodies", "frames", "origins", *TABLES)),
        *(
            (name, _POINTER)
            for name in (
                *("met", "footprints", "depths", "counts", "keys", "members"),
                *("lists", "starts", "values", "owners", "returns"),
            )
        ),
        *((name, _COUNT) for name in ("body_count", "gaussians", "slot_count", "tiles")),
        *(
            (name, _FLOAT)
            for name in (
                *("near_range", "far_range", "pulse", "wide", "high", "spread"),
                *("period", "duration", "seam"),
            )
        ),
    ],
    align=True,
)


# Compilation

FOLDER = Path(__file__).parent / "kernels"
SOURCE = FOLDER / "cast.cu"
KERNELS = ("prepare", "list_tiles", "follow")


def compiled_kernels(architecture: str) -> bytes:
    """The cubin for an architecture (``sm_90``), cached on disk.

    Raises:
        RenderError: compilation failed; the message includes NVRTC's log.
    """
    return _source().kept(architecture)


def compile_kernels(architecture: str) -> tuple[bytes, dict[str, Usage]]:
    """The cubin, cached on disk, and the resource usage of each kernel.

    Raises the errors of :func:`compiled_kernels`.
    """
    code, log = _source().compiled(architecture)
    return code, usage_of(log)


def _source() -> KernelSource:
    return KernelSource(
        name=SOURCE.name,
        kept_as="cast",
        text=SOURCE.read_text(encoding="ascii"),
        folder=FOLDER,
        fma=False,
        error=RenderError,
    )


# The caster

MAX_GAUSSIANS = 1 << 29
MAX_PAIRS = 1 << 31
VALUES = 5
PARTS = ("means", "quats", "scales", "opacities")
"""Arrays of a cloud that are copied to the device."""


class CudaCaster:
    """cast() on the current CUDA device of torch. Calls are serialised across threads.

    Raises:
        RenderError: the kernels do not compile for the device.
    """

    name = "cuda"

    def __init__(self, launcher: Launcher | None = None) -> None:
        self._launcher = launcher or CudaLauncher(KERNELS, compiled_kernels)
        self._lock = threading.Lock()
        self._clouds: weakref.WeakKeyDictionary[GaussianCloud, tuple[Tensor, ...]] = (
            weakref.WeakKeyDictionary()
        )
        self._tables: weakref.WeakKeyDictionary[Beams, dict[str, Tensor]] = (
            weakref.WeakKeyDictionary()
        )

    def cast(self, request: CastRequest) -> Echo:
        """Trace all rays of the request.

        Raises:
            RenderError: too many Gaussians or tile entries to sort at once.
        """
        start = time.perf_counter()
        with self._lock:
            lights = self._follow(request)
        return echo_of(request, lights, {"total": (time.perf_counter() - start) * 1e3})

    def _follow(self, request: CastRequest) -> Lights:
        motions, layout = motions_of(request), layout_of(request.lidar.beams)
        held = _Held(self._launcher)
        sweep = self._sweep(request, motions, layout, held)
        total = int(sweep["gaussians"][0])
        count = request.lidar.beams.count
        pairs = self._pairs(sweep, held, -(-total // THREADS)) if total else 0
        keys, members = held.given["keys"][:pairs], held.given["members"][:pairs]
        order = torch.sort(keys, stable=True)
        edges = held.moved(np.arange(len(layout.rays) + 1, dtype=np.int64) << 32)
        held.write(sweep, "lists", members[order.indices])
        held.write(sweep, "starts", torch.searchsorted(order.values, edges))
        values = held.space(sweep, "values", (count, VALUES), torch.float32)
        owners = held.space(sweep, "owners", (count, 2), torch.int32)
        several = torch.zeros(0, 9)
        if request.lidar.returns > 1:
            several = held.space(sweep, "returns", (count, 9), torch.float32)
        self._launcher.launch("follow", -(-len(layout.rays) // TILES_OF_BLOCK), held.put(sweep))
        return Lights(*(part.cpu().numpy() for part in (values, owners, several)))

    def _pairs(self, sweep: NDArray[np.void], held: _Held, blocks: int) -> int:
        """List the records of each tile; return the number of pairs."""
        self._launcher.launch("prepare", blocks, held.put(sweep))
        ends = torch.cumsum(held.given["counts"], 0)
        held.write(sweep, "counts", ends)
        pairs = int(ends[-1])
        if pairs > MAX_PAIRS:
            raise RenderError(
                f"the sweep has {pairs} pairs of Gaussian and tile, more than the {MAX_PAIRS} that "
                "can be sorted at once; cast fewer rays in a sweep"
            )
        held.space(sweep, "keys", (pairs,), torch.int64)
        held.space(sweep, "members", (pairs,), torch.int32)
        if pairs:
            self._launcher.launch("list_tiles", 2 * blocks, held.put(sweep))
        return pairs

    def _sweep(
        self, request: CastRequest, motions: Motion, layout: BeamLayout, held: _Held
    ) -> NDArray[np.void]:
        """The Sweep structure, with its tables on the device."""
        lidar, sweep = request.lidar, np.zeros(1, SWEEP)
        total = sum(len(instance.cloud) for instance in request.instances)
        if total > MAX_GAUSSIANS:
            raise RenderError(f"{total} Gaussians are more than the {MAX_GAUSSIANS} of a sweep")
        bodies = self._bodies(request, motions, held)
        held.write(sweep, "bodies", held.moved(bodies.view(np.uint8)))
        held.write(sweep, "frames", held.moved(rows_of(motions.to_sensor)))
        held.write(sweep, "origins", held.moved(rows_of(invert_transform(motions.to_sensor))))
        for name, table in self._tables_of(lidar.beams, layout, held).items():
            held.write(sweep, name, table)
        held.space(sweep, "met", (2 * total * MET_BYTES,), torch.uint8)
        held.space(sweep, "footprints", (2 * total,), torch.int64)
        held.space(sweep, "depths", (2 * total,), torch.float32)
        held.space(sweep, "counts", (2 * total,), torch.int64)
        held.space(sweep, "keys", (0,), torch.int64)
        held.space(sweep, "members", (0,), torch.int32)
        sensor = sensor_of(request)
        numbers: Mapping[str, object] = {
            "body_count": len(request.instances),
            "gaussians": total,
            "slot_count": len(lidar.beams.slots[0]),
            "tiles": len(layout.rays),
            "near_range": sensor.near,
            "far_range": sensor.far,
            "pulse": lidar.pulse,
            "seam": layout.seam,
            **{name: getattr(sensor, name) for name in ("wide", "high", "spread")},
            **{name: getattr(sensor, name) for name in ("period", "duration")},
        }
        for name, number in numbers.items():
            sweep[name] = number
        return sweep

    def _bodies(self, request: CastRequest, motions: Motion, held: _Held) -> NDArray[np.void]:
        bodies = np.zeros(max(1, len(request.instances)), BODY)
        first = 0
        pairs = zip(request.instances, request.attributes, strict=True)
        for index, (instance, attributes) in enumerate(pairs):
            body, motion = bodies[index], motions.of_body[index]
            for name, part in zip(PARTS, self._cloud(instance.cloud), strict=True):
                body[name] = held.pointer(part)
            if instance.covars is not None:
                body["covars"] = held.pointer(held.moved(instance.covars.detach()))
            if attributes is not None:
                body["attributes"] = held.pointer(held.moved(attributes))
            body["linear"] = motions.linear[index].reshape(-1)
            body["offset"] = motions.offset[index]
            body["first"], body["count"] = first, len(instance.cloud)
            body["motion"] = motion
            body["speed"], body["turn"] = motions.speed[motion], motions.turn[motion]
            first += len(instance.cloud)
        return bodies

    def _cloud(self, cloud: GaussianCloud) -> tuple[Tensor, ...]:
        found = self._clouds.get(cloud)
        if found is None:
            device = self._launcher.device
            parts = (getattr(cloud, name).detach() for name in PARTS)
            found = tuple(part.to(device).contiguous() for part in parts)
            self._clouds[cloud] = found
        return found

    def _tables_of(self, beams: Beams, layout: BeamLayout, held: _Held) -> dict[str, Tensor]:
        found = self._tables.get(beams)
        if found is None:
            found = {name: held.moved(getattr(layout, name)) for name in TABLES}
            self._tables[beams] = found
        return found


class _Held:
    """Device memory of one sweep, released when the sweep is done.

    Attributes:
        given: tensors that the fields of a Sweep point to, by name.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._kept: list[Tensor] = []
        self.given: dict[str, Tensor] = {}

    def moved(self, values: Tensor | NDArray[np.generic]) -> Tensor:
        """The values on the device; copied only if necessary."""
        tensor = values if isinstance(values, Tensor) else torch.from_numpy(values)
        return tensor.to(self._launcher.device).contiguous()

    def pointer(self, tensor: Tensor) -> int:
        """Address of a tensor, which is kept alive."""
        self._kept.append(tensor)
        return self._launcher.pointer(tensor)

    def write(self, sweep: NDArray[np.void], name: str, tensor: Tensor) -> None:
        """Set a field of a Sweep to the address of a tensor."""
        self.given[name] = tensor
        sweep[name] = self._launcher.pointer(tensor)

    def space(
        self, sweep: NDArray[np.void], name: str, shape: tuple[int, ...], dtype: torch.dtype
    ) -> Tensor:
        """Allocate memory for a field of a Sweep; torch caches freed memory for the next sweep."""
        tensor = torch.empty(shape, dtype=dtype, device=self._launcher.device)
        self.write(sweep, name, tensor)
        return tensor

    def put(self, sweep: NDArray[np.void]) -> int:
        """Copy the structure to the device; return the address."""
        return self.pointer(self.moved(sweep.view(np.uint8).copy()))
