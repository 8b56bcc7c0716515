"""Scenes as files of other programs: splat files baked or one per object, and glTF."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from ..._files import atomic_file, atomic_folder
from ...geometry.transform import Float, invert_transform
from ..cloud import GaussianCloud
from ..errors import SceneError
from ..scene import Scene, SceneObject
from .export_gltf import write_gltf
from .formats import FORMATS, UpAxis
from .splats import format_to_write, upright, write_splats

INDEX_NAME = "objects.json"
INDEX_FORMAT = "real2sim-objects"


def export_scene(
    scene: Scene,
    out: str | PathLike[str],
    *,
    format: str,
    t_us: int | None = None,
    objects: Iterable[str] | None = None,
    up_axis: UpAxis | None = None,
) -> tuple[Path, ...]:
    """Write a scene for other programs, atomically; what is there under ``out`` is replaced.

    ``gltf`` gives one ``.glb`` with a node per object: with its track as an animation, or with
    ``t_us`` standing still as it was then (see :func:`.export_gltf.write_gltf`). The splat formats
    give with ``t_us`` one file of all Gaussians in the world as they were then, and without it a
    folder: the background, each object in its own frame (origin at the box centre), and
    ``objects.json`` with file, category, size and track of each. The sky is in none of them.

    Args:
        scene: what to write.
        out: file to write, or folder where objects become files of their own.
        format: ``gltf``, or the suffix of a splat format without its dot.
        t_us: instant to bake [us]; objects that do not exist then are left out.
        objects: ids of objects to write besides the background; default all.
        up_axis: axis of the files that points up, ``z``, ``y`` or ``-y``, as in
            ``import_splats``; default is the format's: ``y`` for spz, else ``z``. glTF is
            always y up.

    Returns:
        The files written.

    Raises:
        SceneError: an unknown format, object or axis, a time outside the scene, an ``out`` that
            does not fit, or values that are not finite or that the format cannot hold.
        OSError: a file cannot be written.
    """
    splat_formats = {known.suffix[1:]: known for known in FORMATS}
    if format not in {*splat_formats, "gltf"}:
        names = ", ".join([*splat_formats, "gltf"])
        raise SceneError(f"export format {format!r}; allowed are {names}")
    chosen = _chosen(scene, objects)
    if t_us is not None:
        _check_time(scene, t_us)
        chosen = {k: o for k, o in chosen.items() if o.trajectory.covers(t_us)}
    path = Path(out)
    if format == "gltf":
        if up_axis not in (None, "y"):
            raise SceneError(f"up_axis {up_axis!r}; glTF is always y up")
        _check_file(path, ".glb")
        write_gltf(scene, path, objects=chosen, t_us=t_us)
        return (path,)
    axis = up_axis or splat_formats[format].up_axis
    turn = invert_transform(upright(axis, 0.0))
    if t_us is None:
        return _write_folder(scene, chosen, path, f".{format}", axis)
    _check_file(path, f".{format}")
    if format_to_write(path).suffix != f".{format}":
        raise SceneError(f"{path}: this ending means {format_to_write(path).name}, not {format}")
    write_splats(bake(scene, t_us, objects=chosen).moved(turn), path, up_axis=axis)
    return (path,)


def bake(
    scene: Scene, t_us: int, *, objects: Mapping[str, SceneObject] | None = None
) -> GaussianCloud:
    """All Gaussians in the world as they are at ``t_us``: the background first, then objects.

    Objects (default: all of the scene) that do not exist at that time are left out.
    """
    placed = [
        o.cloud.moved(o.trajectory.transform(t_us))
        for o in (scene.objects if objects is None else objects).values()
        if o.trajectory.covers(t_us)
    ]
    return GaussianCloud.concatenate([scene.background, *placed])


def _chosen(scene: Scene, objects: Iterable[str] | None) -> dict[str, SceneObject]:
    if isinstance(objects, str):
        raise SceneError(f"objects must be a list of ids, not the text {objects!r}")
    wanted = None if objects is None else {scene.object(o).object_id for o in objects}
    return {k: o for k, o in scene.objects.items() if wanted is None or k in wanted}


def _check_time(scene: Scene, t_us: int) -> None:
    if not scene.start_us <= t_us <= scene.end_us:
        raise SceneError(
            f"t_us={t_us} is outside scene {scene.name!r}; allowed are {scene.start_us} to "
            f"{scene.end_us}"
        )


def _check_file(path: Path, suffix: str) -> None:
    if not path.name.lower().endswith(suffix):
        raise SceneError(f"{path}: the name of this file must end with {suffix}")
    if path.is_dir():
        raise SceneError(f"{path}: is a folder; name a file")


def _write_folder(
    scene: Scene, objects: dict[str, SceneObject], out: Path, suffix: str, axis: UpAxis
) -> tuple[Path, ...]:
    """Background and objects as files of their own, each in its own frame with ``axis`` up."""
    turn = invert_transform(upright(axis, 0.0))
    if out.exists() and not _is_replaceable(out):
        raise SceneError(
            f"{out}: is there and holds something else than an export; choose another folder or "
            "remove it"
        )
    names = {k: _file_name(i, k) + suffix for i, k in enumerate(objects, start=1)}
    background = f"background{suffix}"
    with atomic_folder(out) as folder:
        write_splats(scene.background.moved(turn), folder / background, up_axis=axis)
        for object_id, scene_object in objects.items():
            cloud = scene_object.cloud.moved(turn)
            write_splats(cloud, folder / names[object_id], up_axis=axis)
        with atomic_file(folder / INDEX_NAME) as file:
            index = _index(scene, objects, names, background=background, turn=turn)
            file.write(json.dumps(index, indent=1).encode())
    return tuple(out / name for name in (background, *names.values(), INDEX_NAME))


def _is_replaceable(out: Path) -> bool:
    """Whether a folder is empty or an export of this kind, so that nothing else gets lost."""
    if not out.is_dir():
        return False
    if not any(out.iterdir()):
        return True
    try:
        index = json.loads((out / INDEX_NAME).read_bytes())
        known = {index["background"], INDEX_NAME, *(o["file"] for o in index["objects"])}
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return index.get("format") == INDEX_FORMAT and {p.name for p in out.iterdir()} <= known


def _file_name(index: int, object_id: str) -> str:
    """A name that is safe in any folder; the number keeps ids apart that look alike in it."""
    return f"{index:03d}_{re.sub(r'[^A-Za-z0-9_-]', '_', object_id)[:60]}"


def _index(
    scene: Scene,
    objects: dict[str, SceneObject],
    names: dict[str, str],
    *,
    background: str,
    turn: Float,
) -> dict[str, Any]:
    """What ``objects.json`` says: what each file is and where its object was when."""
    return {
        "format": INDEX_FORMAT,
        "version": 1,
        "scene": scene.name,
        "content_hash": scene.content_hash,
        "T_file_scene": turn.tolist(),
        "background": background,
        "objects": [
            {
                "object_id": k,
                "file": names[k],
                "category": o.category,
                "size": list(o.size),
                "times_us": o.trajectory.times_us.tolist(),
                "positions": o.trajectory.positions.tolist(),
                "quaternions_wxyz": o.trajectory.quaternions.tolist(),
            }
            for k, o in objects.items()
        ],
    }
