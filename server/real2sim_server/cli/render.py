"""``real2sim render``: draw one logged camera of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .._files import atomic_file
from ..console import CommandError, console, print_figures, write_json
from ..edit.apply import apply_operations
from ..edit.compose import instances_at
from ..edit.state import ScenarioState
from ..render import Frame, RasterOptions, encode_image, render_cameras
from ..scene import Scene
from ..scene.io import load_scene

CODEC_BY_SUFFIX = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}


@dataclass(frozen=True)
class View:
    """Which picture to draw: a camera at a recorded frame, or at a time stamp [us]."""

    camera: str | None = None
    frame: int | None = None
    t_us: int | None = None
    width: int | None = None
    modality: str = "rgb"


def run(
    *,
    scene: Path,
    out: Path,
    view: View,
    delete: list[str],
    log: Path | None,
    backend: str,
    json_path: Path | None,
) -> None:
    """Draw ``view`` of the bundle ``scene`` into ``out``; compare it with ``log`` where given."""
    if log is not None and (view.t_us is not None or delete):
        raise CommandError("--log compares whole recorded frames: use --frame, and no --delete")
    if out.suffix.lower() not in CODEC_BY_SUFFIX:
        raise CommandError(f"--out {out}: the name must end in {', '.join(CODEC_BY_SUFFIX)}")
    loaded = load_scene(scene)
    t_us = _time_of(view, loaded)
    picture = _draw(loaded, view, t_us, delete, backend)
    _write(picture, view.modality, out)
    figures: dict[str, object] = {
        "image": str(out),
        "camera": picture.camera,
        "t_us": t_us,
        "gaussians": loaded.gaussian_count,
    }
    figures |= {f"{stage}_ms": ms for stage, ms in picture.timing_ms.items()}
    if log is not None:
        figures |= _compare(loaded, log, view, picture.camera)
    print_figures(f"{scene.name}, camera {picture.camera}", figures)
    write_json(json_path, figures)


def _time_of(view: View, scene: Scene) -> int:
    if view.t_us is not None:
        return view.t_us
    frame = view.frame or 0
    if frame >= len(scene.frame_times_us):
        raise CommandError(
            f"--frame {frame}; scene {scene.name!r} has frames 0 to {len(scene.frame_times_us) - 1}"
        )
    return int(scene.frame_times_us[frame])


def _draw(scene: Scene, view: View, t_us: int, delete: list[str], backend: str) -> Frame:
    from real2sim_proto.operations import Delete

    state = ScenarioState.of(scene)
    if delete:
        state = apply_operations(state, [Delete(object_id=name) for name in delete]).state
    camera = scene.rig[view.camera] if view.camera else scene.rig.cameras[0]
    if view.width is not None:
        camera = camera.resized(view.width)
    wanted = RasterOptions(depth=view.modality == "depth", instance=view.modality == "instance")
    [frame] = render_cameras(
        instances_at(scene, state, t_us),
        [camera],
        scene.ego.transform(t_us),
        sky=scene.sky,
        options=wanted,
        backend=backend,
    )
    return frame


def _write(frame: Frame, modality: str, out: Path) -> None:
    images = {"rgb": frame.rgb, "depth": frame.depth, "instance": frame.instance}
    codec = CODEC_BY_SUFFIX[out.suffix.lower()]
    if modality not in images:
        raise CommandError(f"--modality {modality!r}; allowed are {', '.join(images)}")
    image = images[modality]
    if modality != "rgb" and codec != "png":
        raise CommandError(f"{modality} images are written as .png, not {out.suffix}")
    with atomic_file(out) as file:
        file.write(encode_image(image, modality, codec).data)


def _compare(scene: Scene, log_path: Path, view: View, camera: str) -> dict[str, float]:
    from ..logs.open import open_log
    from ..reconstruct.evaluation import evaluate_views

    log = open_log(log_path)
    console.print(
        f"comparing with {log.name}, frame {view.frame or 0}, over all pixels and over "
        "those that LiDAR covers"
    )
    report = evaluate_views(scene, log, frames=[view.frame or 0], cameras=[camera])
    return {"psnr_db": report.psnr, "psnr_lidar_db": report.psnr_lidar}
