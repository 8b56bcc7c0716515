"""New scenes from bundles and splat files."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from real2sim_proto import ErrorCode
from real2sim_proto.base import ID_PATTERN

from ...scene import BundleTooLargeError, SceneError
from ...scene.io import (
    SHIPPED_STREET,
    StagingError,
    StagingLimits,
    read_packed,
    save_scene,
    stage_scene,
)
from ..http.responses import ServiceError
from ..storage.connection import FULL_ERRNOS, REFUSED_ERRNOS, is_full, is_refused
from .scenes import SCENE_DOCUMENT, Quota, bundle_folder, folder_usage

# --- Claims --------------------------------------------------------------------------------------

# A file and a reply cannot be stored atomically. A new bundle therefore carries the claim of its
# request until the reply is stored. After a crash, the repeated request recognises its bundle by
# the claim, and for any other request the name is taken.

CLAIM_FILE = ".made_by"


def put_claim(bundle: Path, claim: str | None) -> None:
    """Mark a bundle before it becomes visible; ``claim`` is None for requests without a key."""
    if claim is not None:
        (bundle / CLAIM_FILE).write_text(claim, encoding="utf-8")


def has_claim(bundle: Path, claim: str | None) -> bool:
    """Whether the bundle exists and was created by that request, without a stored reply."""
    try:
        return claim is not None and (bundle / CLAIM_FILE).read_text(encoding="utf-8") == claim
    except (OSError, ValueError):
        return False


def drop_claim(bundle: Path) -> None:
    """Remove the claim of a bundle. A failure is harmless."""
    with contextlib.suppress(OSError):
        (bundle / CLAIM_FILE).unlink(missing_ok=True)


STAGING_PREFIX = ".upload-"
"""Prefix of folders that maintenance removes after a crash."""


def resolve_import(root: Path, given: str) -> Path:
    """The file or bundle at ``given`` below ``root``.

    Raises:
        ServiceError: IMPORT_FAILED if the path leaves ``root`` (also by a link) or does not exist.
    """
    top = root.resolve()
    try:
        target = (top / given).resolve(strict=True)
        # A link inside a bundle could also leave the folder.
        inside = [target, *(p.resolve() for p in target.rglob("*"))]
    except (OSError, ValueError, RuntimeError):
        raise _import_failed(
            f"there is no file or folder {given!r} below the import folder"
        ) from None
    if not all(p.is_relative_to(top) for p in inside) or target == top:
        raise _import_failed(f"path {given!r} leads out of the import folder")
    return target


def import_scene(
    source: Path,
    *,
    scenes: Path,
    name: str,
    limits: StagingLimits,
    quota: Quota,
    claim: str | None = None,
) -> None:
    """Read and check ``source``, and create bundle ``name`` in ``scenes``.

    Args:
        source: bundle or splat file, or the included street.
        scenes: the scene folder.
        name: name of the new scene.
        limits: limits of the process that reads.
        quota: quota of the scene folder.
        claim: claim of the request; an existing bundle with this claim is accepted.

    Raises:
        ServiceError: IMPORT_FAILED if it cannot be read or written, PAYLOAD_TOO_LARGE for its
            content, ALREADY_EXISTS if the name is taken, QUOTA_EXCEEDED.
    """
    folder = bundle_folder(scenes, name)
    if has_claim(folder, claim):
        return
    _check_name(folder, name)
    quota.check()
    with import_errors(source, setting="MAX_SCENE_BYTES"), staging_folder(scenes) as staging:
        staged = staging / folder.name
        if source == SHIPPED_STREET:
            save_scene(read_packed(source), staged)
        else:
            stage_scene(source, staged, name=name, limits=limits)
        quota.check(added_bytes=folder_usage(staged)[1])
        put_claim(staged, claim)
        _check_name(folder, name)
        staged.rename(folder)


@contextmanager
def staging_folder(beside: Path) -> Iterator[Path]:
    """A hidden folder on the disk of ``beside``, removed after the block.

    Raises:
        OSError: it cannot be created.
    """
    beside.mkdir(parents=True, exist_ok=True)
    staging = beside / f"{STAGING_PREFIX}{secrets.token_hex(6)}"
    staging.mkdir()
    try:
        yield staging
    finally:
        shutil.rmtree(staging, ignore_errors=True)


@contextmanager
def import_errors(source: Path, *, setting: str) -> Iterator[None]:
    """Convert errors of the block into errors for clients.

    Args:
        source: imported file; messages omit its path on this machine.
        setting: setting that limits the content.

    Raises:
        ServiceError: IMPORT_FAILED or PAYLOAD_TOO_LARGE.
        OSError: the worker's disk is full or fails.
    """
    try:
        yield
    except BundleTooLargeError as error:
        raise ServiceError(
            ErrorCode.PAYLOAD_TOO_LARGE,
            _public(error, source),
            hint=f"thin it out, or let the operator raise REAL2SIM_{setting} and "
            "REAL2SIM_IMPORT_MEMORY_BYTES",
        ) from error
    except StagingError as error:
        _raise_of_disk(error)
        raise _import_failed(f"it cannot be written: {error}") from error
    except SceneError as error:
        raise _import_failed(_public(error, source)) from error
    except OSError as error:
        if is_full(error) or is_refused(error):
            raise
        raise _import_failed(f"it cannot be written: {error.strerror}") from error


def _raise_of_disk(error: StagingError) -> None:
    """Raise the system's error if the disk is full or missing.

    Exceeding the file size limit of the reading process is an error of the imported file.
    """
    for number in (FULL_ERRNOS | REFUSED_ERRNOS) - {errno.EFBIG}:
        if str(error) == os.strerror(number):
            raise OSError(number, str(error)) from error


def _public(error: Exception, source: Path) -> str:
    return str(error).replace(f"{source.parent.absolute()}/", "").replace(f"{source.parent}/", "")


def _check_name(folder: Path, name: str) -> None:
    if folder.exists() or (folder.parent / name).exists():
        raise ServiceError(
            ErrorCode.ALREADY_EXISTS,
            f"there is a scene {name!r} already",
            hint="give another name in 'scene', or delete the bundle on the worker's disk",
        )


def scene_name(source: Path, given: str | None) -> str:
    """The name of the new scene.

    Raises:
        ServiceError: INVALID_REQUEST if it cannot be part of a path.
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
        hint=f"give a bundle (a folder with {SCENE_DOCUMENT}) or a splat file: "
        ".ply, .compressed.ply, .spz or .splat",
    )


# --- Queue ---------------------------------------------------------------------------------------

T = TypeVar("T")

MAX_IMPORTS = 8
"""Imports being received, waiting or running; each may have an upload on disk."""


class ImportQueue:
    """Runs imports one at a time on a dedicated thread, for use on the event loop.

    A process with limits reads the file, see :mod:`real2sim_server.scene.io.bundle`. With one
    import at a time these limits apply to all imports together.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="imports")
        self._taken = 0

    def close(self) -> None:
        """Stop starting imports."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    @contextmanager
    def place(self) -> Iterator[None]:
        """Reserve a place in the queue before the upload is received.

        Raises:
            ServiceError: QUEUE_FULL.
        """
        if self._taken >= MAX_IMPORTS:
            raise ServiceError(
                ErrorCode.QUEUE_FULL,
                f"{self._taken} imports are under way; {MAX_IMPORTS} is the most",
                hint="send it again after Retry-After seconds",
            )
        self._taken += 1
        try:
            yield
        finally:
            self._taken -= 1

    async def run(self, work: Callable[[], T]) -> T:
        """Run ``work()`` after all earlier imports."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, work)
