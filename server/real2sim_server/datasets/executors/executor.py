"""What an executor is, and the simplest one: clip after clip in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from ...render import Backend
from ...scene import Camera
from ..clips import write_shard
from ..plan import ExportPlan, PlannedClip
from ..variants import Variant


class Executor(Protocol):
    """Makes clips."""

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
            clips: that are not there yet.
            folder: for all of them.
            on_frames: told how many more frames are labelled.

        Raises:
            DatasetError: a clip's makers die again and again.
        """
        ...


class InProcess:
    """One clip after the other, frame by frame.

    Args:
        variants: drives by number.
        cameras: of the export.
        backend: draws.
    """

    def __init__(
        self, variants: Sequence[Variant], cameras: Sequence[Camera], backend: str | Backend
    ) -> None:
        self._variants = variants
        self._cameras = cameras
        self._backend = backend

    def run(
        self,
        plan: ExportPlan,
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> None:
        """See :class:`Executor`."""
        for clip in clips:
            write_shard(
                self._variants[clip.variant],
                plan,
                self._cameras,
                clip,
                folder / clip.name,
                backend=self._backend,
                on_frame=lambda: on_frames(1),
            )
