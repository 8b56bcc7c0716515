"""``real2sim bench detector``: quality of exported labels for training a detector.

A small detector is trained twice: on images and boxes exported from edits of a reconstruction, and
on the same frames ray-cast from the original synthetic street. Both are tested on ray-cast drives
through other streets.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from real2sim_server.console import print_figures, staged_progress
from real2sim_server.datasets.clips import ClipMakers
from real2sim_server.datasets.export import export_dataset
from real2sim_server.datasets.plan import ExportPlan, planned_shards
from real2sim_server.demo.street import SHIPPED
from real2sim_server.executors import Processes
from real2sim_server.scene import Scene
from real2sim_server.scene.io import load_scene, read_packed
from real2sim_server.synthetic import SyntheticConfig

from .detector_model import (
    Detector,
    TrainingImages,
    TrueBoxes,
    average_precision,
    detect,
    train_detector,
)
from .detector_streets import (
    FINER,
    EditedStreets,
    cast_pictures,
    export_plan,
    exported_pictures,
    true_log,
    withheld_drive,
)

Figures = dict[str, Any]
Report = Callable[[str, int, int], None]
EXPORTED, CAST = "trained on exported frames", "trained on ray-cast truth"


@dataclass(frozen=True)
class DetectorBenchOptions:
    """Size of the benchmark.

    Attributes:
        scene: scene bundle of a synthetic drive; None for the demo street.
        frames: training frames of each detector.
        epochs: training epochs.
        drives: test drives through other streets.
        period_us: time between frames of test drives [us].
        width: image width [px].
        seed: seed of edits, exports and training; test drives use the seeds after the scene's.
        workers: export processes.
        camera: camera of all images.
    """

    scene: Path | None = None
    frames: int = 2000
    epochs: int = 8
    drives: int = 4
    period_us: int = 100_000
    width: int = 240
    seed: int = 0
    workers: int = 1
    camera: str = "front"


def run(options: DetectorBenchOptions | None = None) -> Figures:
    """Export, cast, train, test, print and return all figures."""
    options = options or DetectorBenchOptions()
    started = time.process_time()
    scene = read_packed(SHIPPED) if options.scene is None else load_scene(options.scene)
    with tempfile.TemporaryDirectory() as folder, staged_progress() as report:
        pictures = training_sets(scene, options, Path(folder), report)
        models = train_both(pictures, options, report)
        images, truth = _withheld(scene, options, report)
    figures: Figures = {
        "scene": scene.name,
        "frames trained on": len(pictures[CAST].images),
        "frames tested on": len(images),
        "objects tested on": sum(int(one.counts.sum()) for one in truth),
    }
    for name, model in models.items():
        objects = sum(len(boxes) for boxes in pictures[name].boxes)
        precision = average_precision(detect(model, images), truth)
        figures[name] = {**precision, "objects trained on": objects}
    figures["weights"] = sum(p.numel() for p in models[CAST].parameters())
    for measure in ("ap", "ap50"):
        figures[f"ratio of {measure}"] = figures[EXPORTED][measure] / figures[CAST][measure]
    figures["core minutes"] = (time.process_time() - started) / 60
    print_figures("a detector on withheld drives", figures)
    return figures


def training_sets(
    scene: Scene, options: DetectorBenchOptions, folder: Path, report: Report
) -> dict[str, TrainingImages]:
    """The same frames twice: exported, and ray-cast."""
    log, plan = true_log(scene), export_plan(options.camera, options.width, options.seed)
    drives = _drives(scene, plan, options)
    variants, out = drives(), folder / "export"
    makers = ClipMakers(Processes(options.workers), drives) if options.workers > 1 else None
    edits = {"sweeps": [sweep.model_dump(mode="json") for sweep in drives.sweeps]}
    export_dataset(variants, plan, out, made_of=edits, makers=makers, on_progress=report)
    camera = scene.rig[options.camera].resized(options.width * FINER)
    cast = cast_pictures(log, out, camera, partial(report, "cast rays"))
    found, count = {EXPORTED: exported_pictures(out), CAST: cast}, options.frames
    return {n: TrainingImages(p.images[:count], p.boxes[:count]) for n, p in found.items()}


def _drives(scene: Scene, plan: ExportPlan, options: DetectorBenchOptions) -> EditedStreets:
    """Sweeps that yield the requested number of frames."""
    one = EditedStreets.of(scene, 1, options.seed)
    frames = sum(len(clip.times_us) for clip in planned_shards(one(), plan))
    return EditedStreets.of(scene, -(-options.frames // frames), options.seed)


def train_both(
    pictures: dict[str, TrainingImages], options: DetectorBenchOptions, report: Report
) -> dict[str, Detector]:
    """Train one detector per set in parallel, each on one core."""

    def train(name: str) -> Detector:
        return train_detector(
            pictures[name],
            epochs=options.epochs,
            seed=options.seed,
            on_progress=partial(report, f"learn: {name}"),
        )

    with ThreadPoolExecutor(len(pictures)) as pool:
        return dict(zip(pictures, pool.map(train, pictures), strict=True))


def _withheld(
    scene: Scene, options: DetectorBenchOptions, report: Report
) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], list[TrueBoxes]]:
    """Images and objects of the test drives."""
    own = SyntheticConfig.from_values(scene.provenance["config"])
    images, truth = [], []
    for k in range(options.drives):
        from_seed = own.seed + 1 + k
        config = SyntheticConfig(
            seed=from_seed, frames=own.frames, hz=own.hz, width=own.width, height=own.height
        )
        seen, boxes = withheld_drive(config, options.camera, options.width, options.period_us)
        images.append(seen)
        truth += boxes
        report("drives withheld", k + 1, options.drives)
    return np.concatenate(images), truth
