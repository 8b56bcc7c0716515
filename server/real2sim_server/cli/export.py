"""Commands that exchange data with other programs: import, export and export-dataset."""

from __future__ import annotations

import json as json_module
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast, get_args

import typer

from ..console import (
    CommandError,
    console,
    print_figures,
    refuse_existing,
    staged_progress,
    write_json,
)
from .common import (
    JsonFile,
    Overwrite,
    RenderBackend,
    RenderDevice,
    SceneBundle,
    chosen_backend,
    command,
)

if TYPE_CHECKING:
    from real2sim_proto.jobs import DatasetSweep

    from ..datasets.drive import Drive
    from ..datasets.labels.boxes import BoxNoise
    from ..datasets.perturbed import Perturbation
    from ..datasets.plan import Variant
    from ..edit import AssetLookup, ScenarioState
    from ..scene import Scene


# --- import ---------------------------------------------------------------------------------------

UpAxis = Literal["z", "y", "-y"]
CHECKPOINT_SUFFIX = ".pth"


@command("import")
def import_(
    *,
    file: Annotated[
        Path,
        typer.Argument(
            help="Splats (.ply, .compressed.ply, .spz, .splat), a folder of `real2sim export`, or "
            "a checkpoint (.pth) of Street Gaussians or drivestudio."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Bundle to write.")],
    asset: Annotated[
        bool, typer.Option("--asset", help="Import an asset instead of a scene.")
    ] = False,
    category: Annotated[str, typer.Option(help="Category of the asset.")] = "car",
    up_axis: Annotated[
        str | None,
        typer.Option(
            help="Up axis of the file: z, y or -y; default: as stated by the file (y for spz), "
            "otherwise z."
        ),
    ] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="Training data folder of a checkpoint.")
    ] = None,
    frames: Annotated[
        tuple[int, int] | None, typer.Option(help="First and last frame of a checkpoint.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Convert a splat file or checkpoint of another system to a scene, or splats to an asset."""
    refuse_existing(out, overwrite=overwrite)
    if file.suffix.lower() == CHECKPOINT_SUFFIX:
        figures = _import_checkpoint(file, out, dataset, frames, overwrite=overwrite)
    elif up_axis not in (None, *get_args(UpAxis)):
        raise CommandError(f"--up-axis {up_axis!r}; allowed are {', '.join(get_args(UpAxis))}")
    elif asset:
        figures = _import_asset(
            file, out, category, cast("UpAxis | None", up_axis), overwrite=overwrite
        )
    else:
        figures = _import_scene(file, out, cast("UpAxis | None", up_axis), overwrite=overwrite)
    notes = figures.pop("notes", ())
    print_figures(f"imported {file.name}", figures)
    write_json(json, figures | {"notes": notes})
    for note in notes:
        console.print(f"note: {note}", soft_wrap=True, markup=False)


def _import_checkpoint(
    file: Path,
    out: Path,
    dataset: Path | None,
    frames: tuple[int, int] | None,
    *,
    overwrite: bool,
) -> dict[str, Any]:
    from ..reconstruct.imports import CheckpointOptions, import_checkpoint
    from ..scene.io import save_scene

    first, last = frames or (0, None)
    options = CheckpointOptions(dataset=dataset, first_frame=first, last_frame=last, name=out.name)
    imported = import_checkpoint(file, options)
    scene = save_scene(imported.scene, out, overwrite=overwrite)
    return {
        "scene": str(out),
        "objects": len(scene.objects),
        "gaussians": scene.gaussian_count,
        "content_hash": scene.content_hash,
        "notes": list(imported.warnings),
    }


def _import_asset(
    file: Path, out: Path, category: str, up_axis: UpAxis | None, *, overwrite: bool
) -> dict[str, Any]:
    from ..scene.io import import_splats, save_asset

    asset = import_splats(file, name=out.name, as_asset=True, category=category, up_axis=up_axis)
    asset = save_asset(asset, out, overwrite=overwrite)
    return {
        "asset": str(out),
        "up_axis": asset.provenance["up_axis"],
        "gaussians": len(asset.cloud),
        "size_m": " x ".join(f"{edge:.2f}" for edge in asset.size),
        "content_hash": asset.content_hash,
        "notes": asset.provenance["notes"],
    }


def _import_scene(
    file: Path, out: Path, up_axis: UpAxis | None, *, overwrite: bool
) -> dict[str, Any]:
    from ..scene.io import import_exported, import_splats, save_scene

    if file.is_dir():
        if up_axis is not None:
            raise CommandError("--up-axis is for splat files; objects.json states it for a folder")
        scene = import_exported(file, name=out.name)
    else:
        scene = import_splats(file, name=out.name, up_axis=up_axis)
    scene = save_scene(scene, out, overwrite=overwrite)
    return {
        "scene": str(out),
        "up_axis": scene.provenance["up_axis"],
        "gaussians": scene.gaussian_count,
        "content_hash": scene.content_hash,
        "notes": scene.provenance["notes"],
    }


# --- export ---------------------------------------------------------------------------------------


@command("export")
def export(
    *,
    scene: SceneBundle,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output file, or folder with one file per object.")
    ],
    file_format: Annotated[
        str,
        typer.Option("--format", help="Format: ply, compressed.ply, spz, splat, gltf or points."),
    ] = "ply",
    t_us: Annotated[
        int | None, typer.Option(help="Bake the whole scene at this time [us] into one file.")
    ] = None,
    objects: Annotated[
        list[str] | None, typer.Option("--object", help="Export only this object; repeatable.")
    ] = None,
    overwrite: Overwrite = False,
    json: JsonFile = None,
) -> None:
    """Write a scene for other programs.

    Formats: one file per object, the whole scene baked at a time, animated glTF, or plain points
    (one .ply, or a folder with the background and each object).
    """
    from ..scene.io import export_scene, open_scene
    from ..scene.io.splats import FORMATS

    refuse_existing(out, overwrite=overwrite)
    loaded = open_scene(scene)
    if file_format == "points":
        files = _write_points(loaded, out, t_us, objects)
        _tell(scene, loaded.gaussian_count, files, "z", json)
        return
    # export_scene rejects unknown formats and objects, and lists the allowed ones.
    files = export_scene(loaded, out, format=file_format, t_us=t_us, objects=objects or None)
    axes = {"gltf": "y"} | {known.suffix[1:]: known.up_axis for known in FORMATS}
    _tell(scene, loaded.gaussian_count, files, axes[file_format], json)


def _write_points(
    scene: Scene, out: Path, t_us: int | None, objects: list[str] | None
) -> tuple[Path, ...]:
    import numpy as np

    from .._files import atomic_file, atomic_folder
    from ..edit import ScenarioState
    from ..edit.compose import ply_of_points, points_at

    state, instant = ScenarioState.of(scene), scene.start_us if t_us is None else t_us
    placed = state.tracks.at(instant).objects
    chosen = [scene.object(name).object_id for name in objects or scene.objects]
    shown = [o for o in placed if o.object_id in chosen]
    parts = {"background": points_at(scene, state, instant, part="background")}
    for subject in shown:
        number = subject.instance_id
        parts[subject.object_id] = points_at(scene, state, instant, instance_id=number)
    if out.suffix.lower() == ".ply":
        with atomic_file(out) as file:
            file.writelines(ply_of_points(np.concatenate(list(parts.values()))))
        return (out,)
    with atomic_folder(out) as folder:
        for name, rows in parts.items():
            with atomic_file(folder / f"{name}.ply") as file:
                file.writelines(ply_of_points(rows))
    return tuple(out / f"{name}.ply" for name in parts)


def _tell(
    scene: Path, gaussians: int, files: Sequence[Path], up_axis: str, json: Path | None
) -> None:
    figures: dict[str, object] = {
        "files": [str(file) for file in files],
        "bytes": sum(file.stat().st_size for file in files),
        "gaussians": gaussians,
        "up_axis": up_axis,
    }
    print_figures(f"exported {scene.name}", figures)
    write_json(json, figures)


# --- export-dataset -------------------------------------------------------------------------------


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
            help="LiDAR whose returns are the labelled points: hdl-64e, os1-128, ... or a JSON "
            "file (docs/lidar.md); default: points seen by the cameras."
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
            help="Add boxes with the errors of a detector: position=0.2,size=0.05,heading=2,"
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

    If it is interrupted, call it again: it continues after the last complete clip, and the result
    has the same bytes.
    """
    from ..datasets.clips import ClipMakers
    from ..datasets.export import estimate
    from ..datasets.export import export_dataset as export
    from ..datasets.plan import ExportPlan, read_rig
    from ..executors import executor_of
    from ..scene.io import open_scene

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
        open_scene(scene),
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
            "of other categories": manifest["statistics"]["boxes_of_other_categories"],
            "licence": manifest["licence"],
        }
    print_figures(f"data set of {loaded.name}", figures)
    if not dry_run:
        console.print("labels and how they are made: manifest.json and docs/datasets.md")
    write_json(json, figures)


def _variants(path: Path, **options: Any) -> list[Variant]:
    """Recreate the exported drives in a separate process."""
    from ..scene.io import open_scene

    return _swept(open_scene(path), **options)[0]


def _swept(
    scene: Scene,
    *,
    operations: Path | None,
    episode: Path | None,
    assets: Path | None,
    sweep: Path | None,
    seed: int,
) -> tuple[list[Variant], dict[str, Any]]:
    """The exported drives, and the inputs that determine them."""
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
    """The exported drive, and the inputs that determine it."""
    from ..datasets.drive import EpisodeDrive, ScenarioDrive
    from ..service.library.assets import AssetLibrary
    from ..world.recording import load_recording

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
        raise CommandError(f"{operations}: is not a list of edits ({error})") from error
    return apply_operations(state, edits).state


def _content(operations: Path | None) -> Any:
    if operations is None:
        return []
    try:
        return json_module.loads(operations.read_bytes())
    except ValueError as error:
        raise CommandError(f"{operations}: is not a JSON file ({error})") from error


def _sweep(path: Path) -> DatasetSweep:
    from pydantic import ValidationError

    from real2sim_proto.jobs import DatasetSweep

    try:
        return DatasetSweep.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise CommandError(f"{path}: is not a sweep ({error})") from error


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
    """Parse ``name=number,name=number``; numbers must not be negative."""
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
    """A name of the catalogue unchanged, or the values in a file."""
    if name is None or not name.lower().endswith(".json"):
        return name
    try:
        values: dict[str, Any] = json_module.loads(Path(name).read_bytes())
    except (OSError, ValueError) as error:
        raise CommandError(f"--lidar {name}: is not a JSON file ({error})") from error
    return values


def _shares(text: str) -> dict[str, float]:
    """Parse ``train=0.8,val=0.2``."""
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
