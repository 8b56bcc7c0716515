"""Clips made by processes of this machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from ... import executors
from ..errors import DatasetError
from ..plan import ExportPlan, PlannedClip
from .maker import Recipe, ShardMaker


class Processes:
    """So many processes, each with the scene in memory; all begin anew where one dies.

    Args:
        recipe: makes the variants in each.
        workers: processes; they share the cores.
        backend: draws.
    """

    def __init__(self, recipe: Recipe, *, workers: int, backend: str) -> None:
        self._recipe = recipe
        self._workers = workers
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
        tasks = {name: (clip, folder / name) for name, clip in named.items()}
        make = partial(ShardMaker, self._recipe, plan, self._backend)
        try:
            executors.Processes(self._workers).run(
                make, tasks, lambda name, _: on_frames(len(named[name].times_us))
            )
        except executors.ExecutorError as error:
            raise DatasetError(f"clip {error}") from error
