"""Clips made on a Ray cluster, of this machine or of many.

Clips come back as archives, so that the machines need no disk in common.
"""

from __future__ import annotations

import io
import shutil
import tarfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from ... import executors
from ..._files import unpack_tar
from ..errors import DatasetError
from ..plan import ExportPlan, PlannedClip
from .maker import ArchiveMaker, Recipe


class RayWorkers:
    """So many workers, each with the scene in memory.

    Args:
        recipe: makes the variants in each; every machine finds the scene at the same path.
        workers: how many.
        backend: draws.
        address: of an existing cluster, ``auto`` for that of the environment; None starts one on
            this machine, which ends with the export.

    Raises:
        DatasetError: Ray is not installed.
    """

    def __init__(
        self, recipe: Recipe, *, workers: int, backend: str, address: str | None = None
    ) -> None:
        try:
            self._cluster = executors.RayCluster(workers, address=address)
        except executors.ExecutorError as error:
            raise DatasetError(str(error)) from error
        self._recipe = recipe
        self._backend = backend

    def run(
        self,
        plan: ExportPlan,
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> None:
        """See :class:`Executor`."""
        named = {clip.name: clip for clip in clips}

        def keep(name: str, archive: bytes) -> None:
            _unpack(archive, folder / name)
            on_frames(len(named[name].times_us))

        make = partial(ArchiveMaker, self._recipe, plan, self._backend)
        try:
            self._cluster.run(make, named, keep)
        except executors.ExecutorError as error:
            raise DatasetError(f"clip {error}") from error


def _unpack(archive: bytes, folder: Path) -> None:
    """The files of a clip; the folder appears when it is whole."""
    partial_folder = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial_folder, ignore_errors=True)
    partial_folder.mkdir(parents=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        unpack_tar(tar, partial_folder, members=tar)
    partial_folder.rename(folder)
