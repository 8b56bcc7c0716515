"""``real2sim map``: the lanes of a scene: what there is, and from where it gets them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..console import CommandError, console, print_figures, write_json
from .command import command
from .options import JsonFile, LogFormat, SceneBundle, Sequence

if TYPE_CHECKING:
    from ..scene import LaneGraph, Scene


@command("map")
def map_(
    *,
    scene: SceneBundle,
    source: Annotated[
        str | None,
        typer.Option(
            "--from",
            help="FILE.xodr, FILE.osm, lanes.json, a data set's map folder, or `log`.",
        ),
    ] = None,
    log: Annotated[
        Path | None, typer.Option(help="Driving log of the scene, for `--from log`.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(help="Pose of the map's origin in the scene: yaw,x,y [rad, m]."),
    ] = None,
    as_it_is: Annotated[
        bool,
        typer.Option("--as-it-is", help="The map is already in the scene's frame: do not fit it."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output bundle or lanes.json; default: the scene itself."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to write: lanes over a top view of the scene.")
    ] = None,
    log_format: LogFormat = None,
    sequence: Sequence = None,
    json: JsonFile = None,
) -> None:
    """Show the lanes of a scene, or add lanes from a map or the log."""
    from dataclasses import replace

    from ..scene.io import load_scene, save_scene
    from ..scene.io.document import lane_document

    loaded = load_scene(scene)
    figures: dict[str, Any] = {"scene": str(scene)}
    lanes = loaded.lanes
    if source is not None:
        lanes, fitted = _lanes_of(loaded, source, log, _start(at), as_it_is, (log_format, sequence))
        figures |= fitted
    if lanes is None:
        raise CommandError(f"{scene}: has no lanes; give it some with --from FILE or --from log")
    figures |= _figures(lanes)
    if out is not None and out.suffix == ".json":
        out.write_text(lane_document(lanes).model_dump_json(), encoding="utf-8")
        figures["document"] = str(out)
    elif source is not None or out is not None:
        target = out or scene
        save_scene(replace(loaded, lanes=lanes), target, overwrite=out is None)
        figures["scene"] = str(target)
    print_figures(f"lanes of {scene.name}", figures)
    write_json(json, figures | {"notes": list(lanes.notes)})
    for note in lanes.notes:
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    if picture is not None:
        from ..maps.picture import draw_lanes

        draw_lanes(lanes, loaded, picture)
        console.print(f"picture: {picture}", soft_wrap=True)


def _start(at: str | None) -> tuple[float, float, float] | None:
    if at is None:
        return None
    try:
        yaw, x, y = (float(v) for v in at.split(","))
    except ValueError:
        raise CommandError(f"--at {at!r}; give yaw,x,y, such as 0.1,20,-5") from None
    return yaw, x, y


def _lanes_of(
    scene: Scene,
    source: str,
    log: Path | None,
    start: tuple[float, float, float] | None,
    as_it_is: bool,
    reading: tuple[str | None, str | None],
) -> tuple[LaneGraph, dict[str, Any]]:
    """The lanes of a map in the scene's frame, or of its log, and figures of how they fit."""
    from ..logs import same_part
    from ..logs.open import open_log
    from ..maps import align, driven_poses, laid_on, lanes_from_log, read_map

    if source == "log":
        if log is None:
            raise CommandError("--from log needs the driving log: --log FOLDER")
        opened = open_log(log, format=reading[0], sequence=reading[1])
        return lanes_from_log(same_part(opened, scene.provenance)), {}
    graph = read_map(source)
    if as_it_is:
        return laid_on(graph, scene.ground), {}
    fit = align(graph, driven_poses(scene), start=start)
    figures = {
        "turned [rad]": fit.yaw,
        "moved, x [m]": fit.x,
        "moved, y [m]": fit.y,
        "driven poses from centre lines, median [m]": fit.residual,
        "driven poses inside a lane [share]": fit.within,
    }
    return fit.apply(graph, scene.ground), figures


def _figures(lanes: LaneGraph) -> dict[str, Any]:
    from collections import Counter

    kinds = Counter(lane.kind for lane in lanes.lanes.values())
    gaps = list(lanes.gaps.values())
    return {
        "source": lanes.source,
        "accuracy, estimated [m]": "not known" if lanes.accuracy is None else lanes.accuracy,
        "lanes": ", ".join(f"{n} {kind}" for kind, n in kinds.most_common()),
        "length of driving lanes [m]": sum(
            lane.length for lane in lanes.lanes.values() if lane.kind == "driving"
        ),
        "successors": len(gaps),
        "widest gap between successive lanes [m]": max(gaps, default=0.0),
        "areas": len(lanes.areas),
        "stop lines": len(lanes.stop_lines),
        "signals": len(lanes.signals),
        "roads": len(lanes.roads),
    }
