"""``real2sim replay``: live through a recorded episode again, check it, score it, film it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..console import CommandError, console, print_figures, write_json
from ..edit import EditError
from ..geometry.rotation import quaternion_yaw
from ..render import RasterOptions, render_cameras, select_backend
from ..scene import Scene
from ..scene.io import load_scene
from ..service.library.assets import AssetLibrary
from ..world import World
from ..world.recording.mcap_file import save_mcap
from ..world.recording.recording import Recording, RecordingError, first_difference, load_recording
from ..world.recording.replay import Replayer

Image = NDArray[np.uint8]

MAP_PIXELS, MAP_METRES = 160, 60.0


def run(
    *,
    episode: Path,
    scene: Path | None,
    assets: Path | None,
    mcap: Path | None,
    video: Path | None,
    camera: str | None,
    width: int,
    json_path: Path | None,
) -> None:
    """Check that the episode comes out the same, and score it by the formulas of today.

    Raises:
        CommandError: the scene is another one, or an asset of its scenario is missing.
    """
    recording = load_recording(episode)
    figures: dict[str, object] = {
        "steps": len(recording.instants) - 1,
        "recorded_metrics": recording.metrics,
        "scores": [score.fields() for score in recording.rescore()],
    }
    if scene is not None:
        loaded = _scene_of(recording, scene)
        begin = _beginnings(recording, loaded, assets)
        differs = first_difference(recording, begin())
        figures["bit_identical"] = differs is None
        figures["first_difference"] = differs
        if video is not None:
            _film(_instants(recording, begin()), loaded, video, camera=camera, width=width)
            console.print(f"wrote {video}")
    elif video is not None:
        raise CommandError("--video draws the scene; name its bundle with --scene")
    if mcap is not None:
        save_mcap(recording, mcap)
        console.print(f"wrote {mcap}")
    _report(recording, figures)
    if json_path is not None:
        write_json(json_path, figures)
    if figures.get("bit_identical") is False:
        raise CommandError(
            f"the episode comes out differently from step {figures['first_difference']} on; it was "
            "recorded by another version of this program, or on another device"
        )


def _scene_of(recording: Recording, path: Path) -> Scene:
    scene = load_scene(path)
    if scene.content_hash != recording.scene_hash:
        raise CommandError(
            f"the episode ran on a scene with hash {recording.scene_hash[:12]}; {path} has "
            f"{(scene.content_hash or '')[:12]}"
        )
    return scene


def _beginnings(recording: Recording, scene: Scene, assets: Path | None) -> Callable[[], Replayer]:
    """Makes the session before its first entry, as often as wanted."""
    library = AssetLibrary(assets) if assets is not None else None

    def begin() -> Replayer:
        try:
            return recording.fresh(scene, library.find if library else None)
        except EditError as error:
            hint = "name the folder of the worker's asset library with --assets"
            raise CommandError(f"{error}; {hint}") from error
        except RecordingError as error:
            raise CommandError(f"{error} without --scene") from error

    return begin


def _report(recording: Recording, figures: dict[str, object]) -> None:
    then = {s["name"]: s for s in recording.scores}
    rows = {}
    for score in recording.rescore():
        value = "undefined" if score.value is None else f"{score.value:.4g}"
        old = then.get(score.name, {})
        same = old.get("version") == score.version and old.get("value") == score.value
        rows[f"{score.name}@{score.version}"] = value if same else f"{value} (was {old})"
    if "bit_identical" in figures:
        rows["bit-identical"] = "yes" if figures["bit_identical"] else "no"
    print_figures(f"{recording.scene}, {figures['steps']} steps", rows)


# --- film -------------------------------------------------------------------------------------


def _film(
    worlds: Iterator[World], scene: Scene, path: Path, *, camera: str | None, width: int
) -> None:
    """An MP4 of one camera with speed, scores and events, and a map of who is where."""
    chosen = scene.rig[camera or scene.rig.names[0]].resized(width)
    backend, writer = select_backend("auto"), None
    path.parent.mkdir(parents=True, exist_ok=True)
    for world in worlds:
        (frame,) = render_cameras(
            world.instances(),
            [chosen],
            world.T_world_vehicle,
            sky=scene.sky,
            options=RasterOptions(),
            backend=backend,
        )
        picture = np.ascontiguousarray(frame.rgb[:, :, ::-1])
        _caption(picture, world)
        _inset(picture, world)
        if writer is None:
            rate = 1e6 / world.spec.dt_us
            fourcc = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(str(path), fourcc, rate, (chosen.width, chosen.height))
        writer.write(picture)
    if writer is not None:
        writer.release()


def _instants(recording: Recording, retold: Replayer) -> Iterator[World]:
    for entry in recording.entries:
        world = retold.tell(entry)
        if entry.kind in {"reset", "action", "restore"}:
            yield world


def _caption(picture: Image, world: World) -> None:
    found = world.metrics()
    lines = [
        f"{(world.t_us - world.scene.start_us) * 1e-6:5.1f} s  {world.motion.speed:4.1f} m/s",
        f"pdms {found['pdms']:.2f}  completed {100 * found['route_completion']:.0f} %",
        *(f"{e.type} {e.object_id or ''}" for e in world.observe().events),
    ]
    for k, line in enumerate(lines):
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(
                picture, line, (8, 18 + 18 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, thickness
            )


def _inset(picture: Image, world: World) -> None:
    """Map seen from above, the ego in its middle heading up."""
    size = min(MAP_PIXELS, picture.shape[0] // 2, picture.shape[1] // 2)
    scale, motion = size / MAP_METRES, world.motion
    drawn = np.full((size, size, 3), 40, np.uint8)
    cos, sin = math.cos(motion.yaw), math.sin(motion.yaw)

    def place(points: NDArray[np.float64]) -> NDArray[np.int32]:
        d = points - [motion.x, motion.y]
        ahead, left = d @ [cos, sin], d @ [-sin, cos]
        return np.stack([size / 2 - scale * left, 0.75 * size - scale * ahead], 1).astype(np.int32)

    cv2.polylines(drawn, [place(world.context.route)], False, (160, 160, 160), 1)
    agents = world.agents
    for k in range(len(agents.objects)):
        yaw = float(quaternion_yaw(agents.quaternions[k]))
        box = _rectangle(agents.positions[k, :2], yaw, agents.sizes[k])
        cv2.fillPoly(drawn, [place(box)], (60, 140, 255))
    ahead = world.context.centre_ahead
    centre = np.array([motion.x + ahead * cos, motion.y + ahead * sin])
    ego = _rectangle(centre, motion.yaw, np.array(world.scene.ego_size))
    cv2.fillPoly(drawn, [place(ego)], (120, 220, 120))
    picture[-size:, -size:] = drawn


def _rectangle(
    centre: NDArray[np.float64], yaw: float, size: NDArray[np.float64]
) -> NDArray[np.float64]:
    u, v = size[0] / 2, size[1] / 2
    c, s = math.cos(yaw), math.sin(yaw)
    local = np.array([[u, v], [u, -v], [-u, -v], [-u, v]])
    corners: NDArray[np.float64] = local @ np.array([[c, s], [-s, c]]) + centre
    return corners
