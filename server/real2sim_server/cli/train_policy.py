"""``real2sim train-policy``: behaviour cloning of the recording vehicle."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, print_figures, staged_progress, write_json
from .command import command
from .options import JsonFile, LogFormat, Sequence

if TYPE_CHECKING:
    from real2sim.planners.learned import PolicyShape

    from ..policies.posed_images import PosedImage
    from ..scene import CameraRig


@command("train-policy")
def train_policy(
    *,
    source: Annotated[Path, typer.Argument(help="Scene bundle, or folder of a driving log.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of weights (.safetensors).")],
    camera: Annotated[
        str | None, typer.Option(help="Default: the one that looks most nearly ahead.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, max=100_000)] = 60,
    shifted: Annotated[
        int, typer.Option(min=0, max=100, help="Views beside the path per frame, of a scene.")
    ] = 5,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Teach a small network to drive as the recording vehicle did; for planner learned=FILE."""
    from ..logs import open_log
    from ..policies.cloning import build_dataset, save_policy, train_network
    from ..policies.posed_images import log_images, scene_images
    from ..scene.io import load_scene

    start = time.perf_counter()
    with staged_progress() as report:
        if (source / "scene.json").is_file():
            scene = load_scene(source)
            ego, shape = scene.ego, _policy_shape(scene.rig, camera)
            images = scene_images(scene, shape, shifted=shifted, seed=seed)
        else:
            log = open_log(source, format=log_format, sequence=sequence)
            ego, shape = log.ego, _policy_shape(log.rig, camera)
            images = log_images(log, shape)
        dataset = build_dataset(ego, shape, _with_progress(images, report))
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
