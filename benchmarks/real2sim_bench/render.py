"""``real2sim bench render``: rendering time by stage, and relative to the reference."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from real2sim_server.render._reference import ReferenceBackend
from real2sim_server.render.backend import Backend
from real2sim_server.render.frame import warm_up
from real2sim_server.render.rasterize import rasterize
from real2sim_server.render.select import describe_backends, select_backend
from real2sim_server.render.types import Instance, RasterOptions, RenderOutput
from real2sim_server.scene import Sky
from real2sim_server.scene.io import read_splats
from real2sim_server.synthetic.gaussian_street import street_scene

REDUCED_GAUSSIANS = 20_000
REDUCED_SIZE = 4
"""Divisor of the image size in the comparison with the reference, which would take seconds."""

IMAGE_SETS = (("rgb", "RGB"), ("rgb_depth_instance", "RGB + depth + ids"))
"""Key of a timing in a case, and its title."""


@dataclass(frozen=True, eq=False)
class RenderCase:
    """An image to draw."""

    name: str
    instances: list[Instance]
    viewmat: NDArray[np.float64]
    K: NDArray[np.float64]
    width: int
    height: int
    sky: Sky | None = None
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def gaussian_count(self) -> int:
        """Total number of Gaussians of all instances."""
        return sum(len(instance.cloud) for instance in self.instances)

    def draw(self, backend: Backend, *, images: bool) -> RenderOutput:
        """Draw RGB and alpha, plus depth and instance if ``images``."""
        options = RasterOptions(background=self.background, depth=images, instance=images)
        return rasterize(
            self.instances,
            self.viewmat[None],
            self.K[None],
            self.width,
            self.height,
            sky=self.sky,
            options=options,
            backend=backend,
        )

    def reduced(self) -> RenderCase:
        """The case with every Nth Gaussian, in a smaller image."""
        step = -(-self.gaussian_count // REDUCED_GAUSSIANS)
        K = self.K.copy()
        K[:2] /= REDUCED_SIZE
        return replace(
            self,
            instances=[
                replace(i, cloud=i.cloud.select(torch.arange(0, len(i.cloud), step)))
                for i in self.instances
            ],
            K=K,
            width=self.width // REDUCED_SIZE,
            height=self.height // REDUCED_SIZE,
        )


@dataclass(frozen=True)
class Timing:
    """Milliseconds of repeated draws: the best draw with its stages, and the median."""

    best_ms: float
    median_ms: float
    stages_ms: dict[str, float]


def run(
    *,
    splat: Path | None = None,
    backend: str = "auto",
    repetitions: int = 10,
) -> dict[str, Any]:
    """Measure, print a table and return the figures.

    Args:
        splat: file of the first case; by default the biker in the test-data folder, if present.
        backend: see rasterize().
        repetitions: draws of each image, after a warm-up draw.
    """
    console = Console()
    with console.status("measuring the renderer") as status:
        result = bench_render(
            splat=splat,
            backend=backend,
            repetitions=repetitions,
            progress=lambda text: status.update(f"measuring the renderer: {text}"),
        )
    for table in _tables(result):
        console.print(table)
    for note in result["notes"]:
        console.print(note, highlight=False)
    return result


def bench_render(
    *,
    splat: Path | None = None,
    backend: str = "auto",
    repetitions: int = 10,
    street_gaussians: int = 1_000_000,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """Figures of all cases as JSON values; see run().

    Raises:
        BundleError: ``splat`` cannot be read.
    """
    chosen = select_backend(backend)
    progress("compiling")
    warm_up(chosen)
    cases, notes = _cases(splat, street_gaussians)
    rows = [_measure(case, chosen, repetitions, progress) for case in cases]
    reason = next(s.reason for s in describe_backends() if s.name == chosen.name)
    notes.append(
        f"The reference is plain torch; both drew the reduced picture: about {REDUCED_GAUSSIANS:,} "
        f"of the Gaussians at 1/{REDUCED_SIZE} of the width and height, RGB, depth and instance."
    )
    return {"backend": chosen.name, "device": reason, "cases": rows, "notes": notes}


def _cases(splat: Path | None, street_gaussians: int) -> tuple[list[RenderCase], list[str]]:
    street = street_scene(street_gaussians)
    camera = street.camera
    cases = [
        RenderCase(
            name="street",
            instances=street.instances,
            viewmat=camera.viewmat(street.T_world_vehicle),
            K=camera.K,
            width=camera.width,
            height=camera.height,
            sky=street.sky,
        )
    ]
    folder = Path(os.environ.get("REAL2SIM_TEST_DATA", "../shared/data"))
    path = splat or folder / "splats" / "biker.compressed.ply"
    if splat is None and not path.is_file():
        return cases, [f"No splat was measured: {path} is not there; name one with --splat."]
    return [splat_case(path), *cases], []


def splat_case(path: Path) -> RenderCase:
    """An asset at 1920x1280 on white, viewed along +z from 1.6 times its y extent away."""
    cloud = read_splats(path)
    low, high = cloud.means.amin(0).double().numpy(), cloud.means.amax(0).double().numpy()
    eye = (low + high) / 2 - (0, 0, 1.6 * (high - low)[1])
    viewmat = np.eye(4)
    viewmat[:3, 3] = -eye
    K = np.array([[1600.0, 0, 960], [0, 1600, 640], [0, 0, 1]])
    return RenderCase(path.name, [Instance(cloud)], viewmat, K, 1920, 1280)


def _measure(
    case: RenderCase, backend: Backend, repetitions: int, progress: Callable[[str], None]
) -> dict[str, Any]:
    progress(case.name)
    rgb = _time(lambda: case.draw(backend, images=False), repetitions)
    everything = _time(lambda: case.draw(backend, images=True), repetitions)
    progress(f"{case.name}, reference")
    small = case.reduced()
    fast = _time(lambda: small.draw(backend, images=True), repetitions)
    slow = _time(lambda: small.draw(ReferenceBackend(), images=True), 1)
    return {
        "name": case.name,
        "gaussians": case.gaussian_count,
        "width": case.width,
        "height": case.height,
        "rgb": asdict(rgb),
        "rgb_depth_instance": asdict(everything),
        "gaussians_per_second": case.gaussian_count / everything.best_ms * 1e3,
        "reduced": {
            "gaussians": small.gaussian_count,
            "width": small.width,
            "height": small.height,
            f"{backend.name}_ms": fast.best_ms,
            "reference_ms": slow.best_ms,
            "speedup": slow.best_ms / fast.best_ms,
        },
    }


def _time(draw: Callable[[], RenderOutput], repetitions: int) -> Timing:
    """Time draws; several repetitions follow a warm-up draw."""
    times, stages = [], []
    for _ in range(repetitions + (repetitions > 1)):
        start = time.perf_counter()
        output = draw()
        float(output.alpha[0, 0, 0])  # waits for a GPU
        times.append((time.perf_counter() - start) * 1e3)
        stages.append(output.timing_ms)
    counted = times[1:] or times
    best = times.index(min(counted))
    return Timing(times[best], statistics.median(counted), dict(stages[best]))


def _tables(result: dict[str, Any]) -> list[Table]:
    return [_stages_table(result), _reference_table(result)]


def _stages_table(result: dict[str, Any]) -> Table:
    drawn = [(row, row[key], images) for row in result["cases"] for key, images in IMAGE_SETS]
    table = Table(title=f"drawn by {result['backend']} ({result['device']}), milliseconds")
    table.add_column("")
    for row, _, images in drawn:
        size = f"{row['width']}x{row['height']}"
        picture = f"{row['name'].split('.')[0]} {size}\n{row['gaussians']:,}\n{images}"
        table.add_column(picture, justify="right")
    for label, key in (("best", "best_ms"), ("median", "median_ms")):
        table.add_row(label, *(f"{timing[key]:.1f}" for _, timing, _ in drawn))
    for stage in drawn[0][1]["stages_ms"]:
        table.add_row(stage, *(f"{timing['stages_ms'][stage]:.1f}" for _, timing, _ in drawn))
    rates = (row["gaussians"] / timing["best_ms"] / 1e3 for row, timing, _ in drawn)
    table.add_row("M Gaussians/s", *(f"{rate:.2f}" for rate in rates))
    return table


def _reference_table(result: dict[str, Any]) -> Table:
    table = Table(title="against the reference, milliseconds")
    for column in ("picture", "size", "Gaussians", result["backend"], "reference", "times faster"):
        table.add_column(column, justify="left" if column == "picture" else "right")
    for row in result["cases"]:
        small = row["reduced"]
        table.add_row(
            *(row["name"], f"{small['width']}x{small['height']}", f"{small['gaussians']:,}"),
            f"{small[result['backend'] + '_ms']:.1f}",
            f"{small['reference_ms']:.0f}",
            f"{small['speedup']:.0f}",
        )
    return table
