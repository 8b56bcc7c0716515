"""``real2sim export-dataset``: a labelled data set of a scene, a scenario or an episode."""

from __future__ import annotations

import json as json_module
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..console import CommandError, console, print_figures, staged_progress, write_json
from .command import command
from .options import JsonFile, RenderBackend, RenderDevice, SceneBundle, chosen_backend

if TYPE_CHECKING:
    from real2sim_proto.jobs import DatasetSweep

    from ..datasets.drive import Drive
    from ..datasets.labels.boxes import BoxNoise
    from ..datasets.perturbed import Perturbation
    from ..datasets.plan import Variant
    from ..edit import AssetLookup, ScenarioState
    from ..scene import Scene


@command("export-dataset")
def export_dataset(
    *,
    scene: SceneBundle,
    out: Annotated[Path, typer.Option("--out", "-o", help="New output folder.")],
    format_: Annotated[
        list[str],
        typer.Option(
            "--format",
            "-f",
            help="labels, kitti, kitti_raw, coco, nuscenes, argoverse2, waymo, ncore, webdataset, "
            "mcap, pictures",
        ),
    ],
    operations: Annotated[Path | None, typer.Option(help="JSON list of operations.")] = None,
    episode: Annotated[
        Path | None, typer.Option(help="Export a recorded episode (.r2e) of this scene.")
    ] = None,
    assets: Annotated[Path | None, typer.Option(help="Asset library for the edits.")] = None,
    cameras: Annotated[
        str | None, typer.Option(help="Comma-separated cameras; default: all.")
    ] = None,
    width: Annotated[int | None, typer.Option(min=16, max=8192, help="Image width [px].")] = None,
    period: Annotated[float, typer.Option(min=0.001, help="Time between frames [s].")] = 0.1,
    start_us: Annotated[int | None, typer.Option(help="Start time [us].")] = None,
    end_us: Annotated[int | None, typer.Option(help="End time [us].")] = None,
    clip: Annotated[float, typer.Option(min=0.001, help="Maximum length of a clip [s].")] = 20.0,
    splits: Annotated[
        str, typer.Option(help="Share of clips per split, such as train=0.8,val=0.2.")
    ] = "train=1",
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the assignment of clips to splits.")
    ] = 0,
    flow: Annotated[bool, typer.Option(help="Write optical flow.")] = True,
    lidar: Annotated[
        str | None,
        typer.Option(
            help="hdl-64e, os1-128 ... or a JSON file (docs/lidar.md): its returns are the "
            "labelled points. Default: points of what the cameras see."
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(help="JSON file of cameras and LiDAR; replaces --cameras and --lidar."),
    ] = None,
    sweep: Annotated[
        Path | None, typer.Option(help="JSON file of parameters and the operations that use them.")
    ] = None,
    perturb: Annotated[
        str | None,
        typer.Option(help="Offset the ego from its path: lateral=0.5,heading=4,copies=2."),
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            help="Boxes as a detector would give them: position=0.2,size=0.05,heading=2,"
            "missed=0.1,false=0.5."
        ),
    ] = None,
    workers: Annotated[
        int, typer.Option(min=1, max=1024, help="Worker processes; each loads the scene.")
    ] = 1,
    executor: Annotated[
        str, typer.Option(help="Run clips in local processes or on ray.")
    ] = "processes",
    ray_address: Annotated[
        str | None,
        typer.Option(
            help="Address of a Ray cluster ('auto': from the environment); default: start one."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only estimate frames, bytes and minutes.")
    ] = False,
    backend: RenderBackend = "auto",
    device: RenderDevice = None,
    json: JsonFile = None,
) -> None:
    """Export labelled images of a scene, its edits or an episode in public formats.

    Stopped and called again it goes on after the last whole clip, and gives the same bytes.
    """
    from ..datasets.clips import ClipMakers
    from ..datasets.export import estimate
    from ..datasets.export import export_dataset as export
    from ..datasets.plan import ExportPlan, read_rig
    from ..executors import executor_of
    from ..scene.io import load_scene

    backend = chosen_backend(backend, device)
    plan = ExportPlan(
        formats=tuple(dict.fromkeys(format_)),
        cameras=tuple(name.strip() for name in cameras.split(",")) if cameras else (),
        width=width,
        period_us=round(period * 1e6),
        start_us=start_us,
        end_us=end_us,
        clip_s=clip,
        splits=_shares(splits),
        seed=seed,
        flow=flow,
        lidar=_lidar(lidar),
        rig=None if rig is None else read_rig(rig),
        perturb=None if perturb is None else _perturbation(perturb),
        noise=None if noise is None else _noise(noise),
    )
    if rig is not None and (cameras or width or lidar):
        raise CommandError("--rig says all of cameras, width and lidar: leave those out")
    recipe = partial(
        _variants,
        scene,
        operations=operations,
        episode=episode,
        assets=assets,
        sweep=sweep,
        seed=seed,
    )
    variants, made_of = _swept(
        load_scene(scene),
        operations=operations,
        episode=episode,
        assets=assets,
        sweep=sweep,
        seed=seed,
    )
    loaded, makers = variants[0].drive.scene, None
    if workers > 1 or executor != "processes":
        workers_of = executor_of(executor, workers=workers, address=ray_address)
        makers = ClipMakers(workers_of, recipe, backend)
    if dry_run:
        guess = estimate(variants, plan, backend=backend)
        figures: dict[str, Any] = {
            "frames": guess.frames,
            "images": guess.images,
            "bytes": guess.nbytes,
            "minutes": guess.minutes,
        }
    else:
        with staged_progress() as report:
            export(
                variants,
                plan,
                out,
                made_of=made_of,
                backend=backend,
                makers=makers,
                on_progress=report,
            )
        manifest = json_module.loads((out / "manifest.json").read_bytes())
        files = manifest["files"].values()
        figures = {
            "folder": str(out),
            "clips": len(manifest["clips"]),
            "frames": sum(c["frames"] for c in manifest["clips"].values()),
            "files": len(files),
            "bytes": sum(file["bytes"] for file in files),
            "boxes": manifest["statistics"]["boxes"],
            "licence": manifest["licence"],
        }
    print_figures(f"data set of {loaded.name}", figures)
    if not dry_run:
        console.print("labels and how they are made: manifest.json and docs/datasets.md")
    write_json(json, figures)


def _variants(path: Path, **options: Any) -> list[Variant]:
    """What is exported, made anew in a process of its own."""
    from ..scene.io import load_scene

    return _swept(load_scene(path), **options)[0]


def _swept(
    scene: Scene,
    *,
    operations: Path | None,
    episode: Path | None,
    assets: Path | None,
    sweep: Path | None,
    seed: int,
) -> tuple[list[Variant], dict[str, Any]]:
    """What is exported, and what decided on it."""
    from ..datasets.drive import ScenarioDrive
    from ..datasets.plan import Variant, swept

    drive, made_of = _drive(scene, operations, episode, assets)
    if sweep is None:
        return [Variant(drive)], made_of
    if not isinstance(drive, ScenarioDrive):
        raise CommandError("--episode is exported as it went: leave --sweep out")
    asked = _sweep(sweep)
    made_of["sweep"] = asked.model_dump(mode="json", exclude_none=True)
    return swept(scene, drive.state, asked, seed), made_of


def _drive(
    scene: Scene, operations: Path | None, episode: Path | None, assets: Path | None
) -> tuple[Drive, dict[str, Any]]:
    """What is shown, and what decided on it."""
    from ..datasets.drive import EpisodeDrive, ScenarioDrive
    from ..service.library.assets import AssetLibrary
    from ..world.recording.recording import load_recording

    lookup = AssetLibrary(assets).find if assets is not None else None
    if episode is not None:
        if operations is not None:
            raise CommandError("--episode is exported as it went: leave --operations out")
        recording = load_recording(episode)
        return EpisodeDrive.of(recording, scene, assets=lookup), {"episode": recording.digests[-1]}
    state = _edited(scene, operations, lookup)
    return ScenarioDrive(scene, state), {"operations": _content(operations)}


def _edited(scene: Scene, operations: Path | None, lookup: AssetLookup | None) -> ScenarioState:
    from pydantic import TypeAdapter, ValidationError

    from real2sim_proto.operations import Operation

    from ..edit import ScenarioState, apply_operations

    state = ScenarioState.of(scene, assets=lookup)
    if operations is None:
        return state
    try:
        edits = TypeAdapter(list[Operation]).validate_python(_content(operations))
    except ValidationError as error:
        raise CommandError(f"{operations}: is no list of edits ({error})") from error
    return apply_operations(state, edits).state


def _content(operations: Path | None) -> Any:
    if operations is None:
        return []
    try:
        return json_module.loads(operations.read_bytes())
    except ValueError as error:
        raise CommandError(f"{operations}: is no JSON file ({error})") from error


def _sweep(path: Path) -> DatasetSweep:
    from pydantic import ValidationError

    from real2sim_proto.jobs import DatasetSweep

    try:
        return DatasetSweep.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise CommandError(f"{path}: is no sweep ({error})") from error


def _perturbation(text: str) -> Perturbation:
    from ..datasets.perturbed import Perturbation

    given = _numbers("--perturb", text, ("lateral", "heading", "recover", "copies"))
    default = Perturbation()
    return Perturbation(
        lateral_sigma=given.get("lateral", default.lateral_sigma),
        heading_sigma=math.radians(given.get("heading", math.degrees(default.heading_sigma))),
        recover_s=given.get("recover", default.recover_s),
        copies=max(1, round(given.get("copies", default.copies))),
    )


def _noise(text: str) -> BoxNoise:
    from ..datasets.labels.boxes import BoxNoise

    given = _numbers("--noise", text, ("position", "size", "heading", "missed", "false"))
    if "heading" in given:
        given["heading"] = math.radians(given["heading"])
    return BoxNoise(**given)


def _numbers(option: str, text: str, allowed: tuple[str, ...]) -> dict[str, float]:
    """Of ``name=number,name=number``, none below 0."""
    found = {}
    for part in text.split(","):
        name, _, number = part.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            found[name.strip()] = -1.0
    if set(found) - set(allowed) or min(found.values()) < 0:
        raise CommandError(
            f"{option} {text!r}; allowed are {', '.join(f'{n}=0.5' for n in allowed)}"
        )
    return found


def _lidar(name: str | None) -> str | dict[str, Any] | None:
    """A name of the catalogue as it is, or the values in a file."""
    if name is None or not name.endswith(".json"):
        return name
    try:
        values: dict[str, Any] = json_module.loads(Path(name).read_bytes())
    except (OSError, ValueError) as error:
        raise CommandError(f"--lidar {name}: is no JSON file ({error})") from error
    return values


def _shares(text: str) -> dict[str, float]:
    """Of ``train=0.8,val=0.2``."""
    shares = {}
    for part in text.split(","):
        name, equals, share = part.partition("=")
        try:
            shares[name.strip()] = float(share if equals else "")
        except ValueError:
            raise CommandError(
                f"--splits {text!r}; allowed are shares such as train=0.8,val=0.2"
            ) from None
    return shares
