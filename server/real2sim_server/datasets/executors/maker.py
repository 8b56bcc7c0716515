"""A maker of clips in a process of its own: it holds the scene and makes what it is given."""

from __future__ import annotations

import io
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from ..clips import write_shard
from ..plan import ExportPlan, PlannedClip, planned_cameras
from ..variants import Variant

Recipe = Callable[[], Sequence[Variant]]
"""Makes the variants; it can be pickled, and finds its files in every worker."""


class ShardMaker:
    """Holds the variants of an export.

    Args:
        recipe: makes them, once.
        plan: of the export.
        backend: draws.
        threads: that this maker computes with.
    """

    def __init__(self, recipe: Recipe, plan: ExportPlan, backend: str, threads: int) -> None:
        import numba
        import torch

        numba.set_num_threads(min(threads, numba.get_num_threads()))
        torch.set_num_threads(threads)
        self._variants = recipe()
        self._plan = plan
        self._cameras = planned_cameras(self._variants[0].drive, plan)
        self._backend = backend

    def make(self, task: tuple[PlannedClip, Path]) -> None:
        """Make a clip as a folder, which appears when it is whole; one that is there is left."""
        clip, folder = task
        if not folder.exists():
            self._write(clip, folder)

    def make_archive(self, clip: PlannedClip) -> bytes:
        """The files of a clip as a tar, for whoever shares no disk."""
        with tempfile.TemporaryDirectory(prefix="real2sim-clip-") as place:
            folder = Path(place) / clip.name
            self._write(clip, folder)
            file = io.BytesIO()
            with tarfile.open(fileobj=file, mode="w") as tar:
                for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                    tar.add(path, str(path.relative_to(folder)))
            return file.getvalue()

    def _write(self, clip: PlannedClip, folder: Path) -> None:
        variant = self._variants[clip.variant]
        write_shard(variant, self._plan, self._cameras, clip, folder, backend=self._backend)


class ArchiveMaker(ShardMaker):
    """The same for whoever shares no disk: clips come back as archives."""

    def make(self, task: PlannedClip) -> bytes:  # type: ignore[override]
        """The files of a clip as a tar."""
        return self.make_archive(task)
