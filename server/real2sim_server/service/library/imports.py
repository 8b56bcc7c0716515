"""New scenes from bundles and splat files."""

from __future__ import annotations

import re
from pathlib import Path

from real2sim_proto import ErrorCode
from real2sim_proto.base import ID_PATTERN

from ...scene import BundleError, SceneError
from ...scene.io import import_splats, load_scene, save_scene
from ..http.problems import ServiceError
from .scene_catalog import SCENE_DOCUMENT, bundle_folder


def resolve_import(root: Path, given: str) -> Path:
    """The file or bundle at ``given`` below ``root``.

    Raises:
        ServiceError: IMPORT_FAILED when it leads out of ``root`` (also by a link), or when there
            is nothing.
    """
    top = root.resolve()
    try:
        target = (top / given).resolve(strict=True)
        # A link inside a bundle could lead out of the folder just as well.
        inside = [target, *(p.resolve() for p in target.rglob("*"))]
    except (OSError, ValueError, RuntimeError):
        raise _import_failed(
            f"there is no file or folder {given!r} below the import folder"
        ) from None
    if not all(p.is_relative_to(top) for p in inside) or target == top:
        raise _import_failed(f"path {given!r} leads out of the import folder")
    return target


def import_scene(source: Path, *, scenes: Path, name: str) -> None:
    """Read ``source`` whole, check it, and write it as bundle ``name`` below ``scenes``.

    Raises:
        ServiceError: IMPORT_FAILED when it cannot be read, ALREADY_EXISTS when the name is taken.
    """
    folder = bundle_folder(scenes, name)
    if folder.exists() or (scenes / name).exists():
        raise ServiceError(
            ErrorCode.ALREADY_EXISTS,
            f"there is a scene {name!r} already",
            hint="give another name in 'scene', or delete the bundle on the worker's disk",
        )
    try:
        scene = load_scene(source) if source.is_dir() else import_splats(source, name=name)
        save_scene(scene, folder)
    except BundleError as error:
        raise _import_failed(str(error).replace(f"{source.parent}/", "")) from error
    except SceneError as error:
        raise _import_failed(str(error)) from error
    except OSError as error:
        raise _import_failed(f"scene {name!r} cannot be written: {error.strerror}") from error


def scene_name(source: Path, given: str | None) -> str:
    """The name to import under.

    Raises:
        ServiceError: INVALID_REQUEST when it cannot be part of a path.
    """
    if given is None:
        stem = source.name.split(".")[0]
        given = re.sub(r"[^A-Za-z0-9_\-]+", "_", stem).strip("_-")
    if not re.match(ID_PATTERN, given):
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"scene name {given!r} must match {ID_PATTERN}",
            hint="give a name in 'scene'",
        )
    return given


def _import_failed(detail: str) -> ServiceError:
    return ServiceError(
        ErrorCode.IMPORT_FAILED,
        detail,
        hint=f"give a bundle (a folder with {SCENE_DOCUMENT}) or a Gaussian splat ply",
    )
