"""Clips of an export, made by the processes or the Ray cluster of an executor.

The bytes of a clip do not depend on who makes it, and it is made again if its maker dies. Clips
come back as archives, so that the machines of a cluster need no disk in common.
"""

from __future__ import annotations

import io
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from .._files import unpack_tar
from ..executors import Executor, ExecutorError
from .clips import write_shard
from .drive import DatasetError
from .plan import ExportPlan, PlannedClip, Variant, planned_cameras

Recipe = Callable[[], Sequence[Variant]]
"""Makes the variants of an export; it can be pickled, and every worker finds its files."""


@dataclass(frozen=True)
class ClipMakers:
    """Workers that each hold the scene in memory and make clips of an export.

    Attributes:
        executor: runs the workers.
        recipe: makes the variants in each of them.
        backend: name of the renderer's backend.
    """

    executor: Executor
    recipe: Recipe
    backend: str = "auto"

    def run(
        self,
        plan: ExportPlan,
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> None:
        """Make each clip as a folder of its name below ``folder``, which appears when it is whole.

        Args:
            plan: of the export.
            clips: missing clips.
            folder: for all of them.
            on_frames: called with the number of frames of each finished clip.

        Raises:
            DatasetError: the makers of a clip die again and again.
        """
        named = {clip.name: clip for clip in clips}

        def keep(name: str, archive: bytes) -> None:
            _unpack(archive, folder / name)
            on_frames(len(named[name].times_us))

        try:
            self.executor.run(partial(_ClipMaker, self.recipe, plan, self.backend), named, keep)
        except ExecutorError as error:
            raise DatasetError(f"clip {error}") from error


class _ClipMaker:
    """A worker of an executor; computes with ``threads`` threads."""

    def __init__(self, recipe: Recipe, plan: ExportPlan, backend: str, threads: int) -> None:
        import numba
        import torch

        numba.set_num_threads(min(threads, numba.get_num_threads()))
        torch.set_num_threads(threads)
        self._variants = recipe()
        self._plan = plan
        self._cameras = planned_cameras(self._variants[0].drive, plan)
        self._backend = backend

    def make(self, clip: PlannedClip) -> bytes:
        """The files of a clip as a tar archive."""
        with tempfile.TemporaryDirectory(prefix="real2sim-clip-") as place:
            folder = Path(place) / clip.name
            variant = self._variants[clip.variant]
            write_shard(variant, self._plan, self._cameras, clip, folder, backend=self._backend)
            file = io.BytesIO()
            with tarfile.open(fileobj=file, mode="w") as tar:
                for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                    tar.add(path, str(path.relative_to(folder)))
            return file.getvalue()


def _unpack(archive: bytes, folder: Path) -> None:
    """Write the files of a clip; the folder appears when it is whole."""
    partial_folder = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial_folder, ignore_errors=True)
    partial_folder.mkdir(parents=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        unpack_tar(tar, partial_folder, members=tar)
    partial_folder.rename(folder)
