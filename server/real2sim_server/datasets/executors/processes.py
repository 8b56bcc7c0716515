"""Clips made by processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from ..errors import DatasetError
from ..plan import ExportPlan, PlannedClip
from .executor import MOST_TRIES
from .maker import Recipe, ShardMaker

_maker: ShardMaker | None = None


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
        tries: Counter[str] = Counter()
        left = list(clips)
        while left:
            left = self._made(plan, left, folder, on_frames)
            # Whichever of them it was, all that is left was begun once more.
            tries.update(clip.name for clip in left)
            for clip in left:
                if tries[clip.name] >= MOST_TRIES * len(clips):
                    raise DatasetError(
                        f"clip {clip.name}: its processes died {tries[clip.name]} times; is there "
                        "enough memory for so many workers?"
                    )

    def _made(
        self,
        plan: ExportPlan,
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> list[PlannedClip]:
        """Clips that are still to be made once a process has died; none where all went well."""
        threads = max(1, (os.cpu_count() or 1) // self._workers)
        workers = min(self._workers, len(clips))
        with ProcessPoolExecutor(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(self._recipe, plan, self._backend, threads),
        ) as pool:
            waiting: dict[Future[None], PlannedClip] = {}
            try:
                for clip in clips:
                    waiting[pool.submit(_make, clip, folder / clip.name)] = clip
                for done in as_completed(list(waiting)):
                    done.result()
                    on_frames(len(waiting.pop(done).times_us))
            except BrokenProcessPool:
                return [clip for clip in clips if not (folder / clip.name).exists()]
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        return []


def _begin(recipe: Recipe, plan: ExportPlan, backend: str, threads: int) -> None:
    global _maker  # noqa: PLW0603, a process of the pool has one
    _maker = ShardMaker(recipe, plan, backend, threads)


def _make(clip: PlannedClip, folder: Path) -> None:
    assert _maker is not None
    _maker.make(clip, folder)
