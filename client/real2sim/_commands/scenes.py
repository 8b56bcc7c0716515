"""``real2sim status``, ``scenes`` and ``frame``: the worker, its scenes, and images of them."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import (
    DEFAULT_URL,
    JsonFile,
    Timeout,
    Token,
    Url,
    connected,
    console,
    save_image,
    write_json,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from real2sim_proto.scenes import SceneInfo


# The worker's state.

app = typer.Typer()


@app.command()
def status(
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 10.0,
    json_file: JsonFile = None,
) -> None:
    """Show a worker's version, device and limits; exit code 1 if it is not ready."""
    with connected(url, token, timeout) as client:
        info, readiness = client.server(), client.readiness()
    if json_file is not None:
        write_json(
            json_file,
            {"server": info.model_dump(mode="json"), "readiness": readiness.model_dump()},
        )
    else:
        state = "ready" if readiness.ready else "not ready: " + "; ".join(readiness.reasons)
        out = console()
        out.print(f"worker [bold]{info.worker_id}[/bold] at {url}: {state}")
        out.print(f"version {info.version}, protocol {info.protocol_version}")
        device = info.device
        out.print(
            f"renders with {device.backend} on {device.device}, {device.threads} threads "
            f"({device.reason})",
            highlight=False,
        )
        limits = ", ".join(f"{name} {value}" for name, value in info.limits.model_dump().items())
        out.print(f"limits: {limits}", highlight=False)
    if not readiness.ready:
        raise typer.Exit(1)


class Modality(StrEnum):
    """Modality of an image."""

    RGB = "rgb"
    DEPTH = "depth"
    INSTANCE = "instance"
    MEDIAN_DEPTH = "median_depth"
    SEMANTIC = "semantic"
    UNCERTAINTY = "uncertainty"


@app.command()
def scenes(
    url: Url = DEFAULT_URL, token: Token = None, timeout: Timeout = 30.0, json_file: JsonFile = None
) -> None:
    """List a worker's scenes."""
    with connected(url, token, timeout) as client:
        found = client.scenes.list()
    if json_file is not None:
        write_json(json_file, [scene.model_dump(mode="json") for scene in found])
        return
    if not found:
        from real2sim_proto.scenes import WITHOUT_SCENES

        typer.echo(f"the worker has no scenes; {WITHOUT_SCENES}")
        return
    console().print(_table(found))


@app.command()
def frame(
    *,
    camera: Annotated[str, typer.Option(help="Name of a camera.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Image to write: .jpg, .png or .npy.")],
    scene: Annotated[str | None, typer.Option(help="Name of a scene.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Id of a scenario.")] = None,
    t_us: Annotated[int | None, typer.Option(help="Time [us]; default: the start.")] = None,
    width: Annotated[
        int | None, typer.Option(min=16, help="Image width [px]; default: as recorded.")
    ] = None,
    modality: Annotated[Modality, typer.Option(help="Kind of image.")] = Modality.RGB,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Render one frame of a scene or scenario on a worker."""
    if (scene is None) == (scenario is None):
        raise typer.BadParameter("give exactly one of --scene and --scenario")
    codec = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}.get(out.suffix.lower(), "raw")
    with connected(url, token, timeout) as client:
        if scene is not None:
            image = client.scenes.render(
                scene, camera=camera, t_us=t_us, width=width, modality=modality, codec=codec
            )
        else:
            image = client.scenarios.get(str(scenario)).preview(
                camera=camera, t_us=t_us, width=width, modality=modality, codec=codec
            )
    save_image(image, out)


def _table(found: Sequence[SceneInfo]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading in ("scene", "state", "seconds", "cameras", "objects", "Gaussians", "MB"):
        table.add_column(heading, justify="left" if heading in {"scene", "state"} else "right")
    for scene in found:
        table.add_row(
            scene.scene,
            scene.state.value if scene.reason is None else f"{scene.state.value}: {scene.reason}",
            f"{(scene.end_us - scene.start_us) * 1e-6:.1f}",
            str(len(scene.cameras)),
            str(len(scene.objects)),
            f"{scene.gaussians:,}",
            f"{scene.bytes * 1e-6:.0f}",
        )
    return table
