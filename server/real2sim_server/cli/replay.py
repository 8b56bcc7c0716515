"""``real2sim replay``: live through a recorded episode again, check it, score it, film it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..console import CommandError, console, print_figures, write_json
from .command import command
from .options import JsonFile

if TYPE_CHECKING:
    from ..scene import Scene
    from ..world.recording.recording import Recording
    from ..world.recording.replay import Replayer


@command("replay")
def replay(
    *,
    episode: Annotated[Path, typer.Argument(help="Recording of an episode (.r2e).")],
    scene: Annotated[
        Path | None, typer.Option("--scene", help="Scene bundle; simulates the episode again.")
    ] = None,
    assets: Annotated[
        Path | None, typer.Option("--assets", help="Asset library of the scenario.")
    ] = None,
    mcap: Annotated[Path | None, typer.Option("--mcap", help="Also write an MCAP file.")] = None,
    video: Annotated[Path | None, typer.Option("--video", help="Video (MP4) to write.")] = None,
    camera: Annotated[
        str | None, typer.Option(help="Camera of the video; default: the first.")
    ] = None,
    width: Annotated[int, typer.Option(min=64, max=4096, help="Width of the video [px].")] = 640,
    json: JsonFile = None,
) -> None:
    """Score a recorded episode; with its scene, verify and film it."""
    from ..policies.page import film_episode
    from ..world.recording.mcap_file import save_mcap
    from ..world.recording.recording import first_difference, load_recording

    recording = load_recording(episode)
    figures: dict[str, object] = {
        "steps": len(recording.instants) - 1,
        "recorded_metrics": recording.metrics,
        "scores": [score.fields() for score in recording.rescore()],
    }
    if scene is not None:
        loaded = _load_its_scene(recording, scene)
        start = _replay_factory(recording, loaded, assets)
        difference = first_difference(recording, start())
        figures["bit_identical"] = difference is None
        figures["first_difference"] = difference
        if video is not None:
            film_episode(recording, start(), loaded, video, camera=camera, width=width)
            console.print(f"wrote {video}")
    elif video is not None:
        raise CommandError("--video draws the scene; name its bundle with --scene")
    if mcap is not None:
        save_mcap(recording, mcap)
        console.print(f"wrote {mcap}")
    _print_scores(recording, figures)
    write_json(json, figures)
    if figures.get("bit_identical") is False:
        raise CommandError(
            f"the episode comes out differently from step {figures['first_difference']} on; it was "
            "recorded by another version of this program, or on another device"
        )


def _load_its_scene(recording: Recording, path: Path) -> Scene:
    from ..scene.io import load_scene

    scene = load_scene(path)
    if scene.content_hash != recording.scene_hash:
        raise CommandError(
            f"the episode ran on a scene with hash {recording.scene_hash[:12]}; {path} has "
            f"{(scene.content_hash or '')[:12]}"
        )
    return scene


def _replay_factory(
    recording: Recording, scene: Scene, assets: Path | None
) -> Callable[[], Replayer]:
    """Makes the session as it was before its first entry, as often as wanted."""
    from ..edit import EditError
    from ..service.library.assets import AssetLibrary
    from ..world.recording.recording import RecordingError

    library = AssetLibrary(assets) if assets is not None else None

    def start() -> Replayer:
        try:
            return recording.replayer(scene, library.find if library else None)
        except EditError as error:
            hint = "name the folder of the worker's asset library with --assets"
            raise CommandError(f"{error}; {hint}") from error
        except RecordingError as error:
            raise CommandError(f"{error} without --scene") from error

    return start


def _print_scores(recording: Recording, figures: dict[str, object]) -> None:
    recorded = {score["name"]: score for score in recording.scores}
    rows = {}
    for score in recording.rescore():
        value = "undefined" if score.value is None else f"{score.value:.4g}"
        old = recorded.get(score.name, {})
        same = old.get("version") == score.version and old.get("value") == score.value
        rows[f"{score.name}@{score.version}"] = value if same else f"{value} (was {old})"
    if "bit_identical" in figures:
        rows["bit-identical"] = "yes" if figures["bit_identical"] else "no"
    print_figures(f"{recording.scene}, {figures['steps']} steps", rows)
    for score in recording.rescore():
        if score.cannot_see:
            console.print(f"[dim]{score.name}: {score.cannot_see}[/dim]")
