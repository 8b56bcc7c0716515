"""``real2sim train-policy``: behaviour cloning of the recording vehicle."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, print_figures, staged_progress, write_json
from .command import command
from .options import JsonFile, LogFormat, Sequence

if TYPE_CHECKING:
    from real2sim.planners.learned import PolicyShape

    from ..policies.cloning import CloningDataset, PosedImage
    from ..scene import CameraRig


@command("train-policy")
def train_policy(
    *,
    sources: Annotated[
        list[Path],
        typer.Argument(help="Scene bundle, driving log, or data sets of export-dataset."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Weights to write (.safetensors).")],
    camera: Annotated[
        str | None, typer.Option(help="Camera; default: the most forward-facing.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, max=100_000)] = 60,
    shifted: Annotated[
        int,
        typer.Option(min=0, max=100, help="Rendered views beside the path per frame of a scene."),
    ] = 5,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Train a small network to imitate the recorded driving, for --planner learned=FILE."""
    from ..policies.cloning import save_policy, train_network

    start = time.perf_counter()
    with staged_progress() as report:
        shape, dataset = _examples(
            sources,
            report,
            camera=camera,
            shifted=shifted,
            seed=seed,
            log_format=log_format,
            sequence=sequence,
        )
        weights, figures = train_network(
            dataset,
            shape,
            epochs=epochs,
            seed=seed,
            on_progress=lambda done, total: report("learn", done, total),
        )
    save_policy(weights, shape, out)
    figures |= {"examples": len(dataset.images), "seconds": time.perf_counter() - start}
    print_figures(f"policy for camera {shape.camera}", figures)
    write_json(json, figures)


def _examples(
    sources: list[Path],
    report: Callable[[str, int, int], None],
    *,
    camera: str | None,
    shifted: int,
    seed: int,
    log_format: str | None,
    sequence: str | None,
) -> tuple[PolicyShape, CloningDataset]:
    from ..logs import open_log
    from ..policies.cloning import (
        build_dataset,
        exported_examples,
        exported_shape,
        is_export,
        log_images,
        scene_images,
    )
    from ..scene.io import load_scene

    if all(is_export(source) for source in sources):
        shape = exported_shape(sources[0], camera)
        read = partial(report, "read")
        return shape, exported_examples(sources, shape, on_progress=read)
    if len(sources) > 1:
        raise CommandError("several sources must all be data sets that export-dataset has written")
    (source,) = sources
    if (source / "scene.json").is_file():
        scene = load_scene(source)
        ego, shape = scene.ego, _policy_shape(scene.rig, camera)
        images = scene_images(scene, shape, shifted=shifted, seed=seed)
    else:
        log = open_log(source, format=log_format, sequence=sequence)
        ego, shape = log.ego, _policy_shape(log.rig, camera)
        images = log_images(log, shape)
    return shape, build_dataset(ego, shape, _with_progress(images, report))


def _policy_shape(rig: CameraRig, camera: str | None) -> PolicyShape:
    from real2sim.planners.learned import PolicyShape

    if camera is not None and camera not in rig.names:
        raise CommandError(f"no camera {camera!r}; there are {', '.join(rig.names)}")
    ahead = max(rig, key=lambda one: one.T_vehicle_camera[0, 2]).name
    return PolicyShape(camera=camera or ahead)


def _with_progress(
    images: Iterable[PosedImage], report: Callable[[str, int, int], None]
) -> Iterator[PosedImage]:
    for done, image in enumerate(images, start=1):
        report("look", done, image.count)
        yield image
