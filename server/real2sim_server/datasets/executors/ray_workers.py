"""Clips made on a Ray cluster, of this machine or of many.

A worker holds the scene as an actor. Where it or its machine dies, Ray begins it anew and the clip
that it was at is made again, which costs that clip's time only. Clips come back as archives, so
that the machines need no disk in common.
"""

from __future__ import annotations

import io
import os
import shutil
import tarfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..errors import DatasetError
from ..plan import ExportPlan, PlannedClip
from .executor import MOST_TRIES
from .maker import Recipe, ShardMaker


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
            import ray
        except ImportError as error:
            raise DatasetError(
                f"the executor 'ray' needs the ray extra: pip install 'real2sim[ray]' ({error})"
            ) from error
        self._ray: Any = ray
        self._recipe = recipe
        self._workers = workers
        self._backend = backend
        self._address = address

    def run(
        self,
        plan: ExportPlan,
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> None:
        """See :class:`Executor`."""
        if not clips:
            return
        ray, begun = self._ray, not self._ray.is_initialized()
        if begun:
            self._connect()
        try:
            makers = self._makers(plan, min(self._workers, len(clips)))
            try:
                self._make_all(makers, clips, folder, on_frames)
            finally:
                for actor in makers:
                    ray.kill(actor)
        finally:
            if begun:
                ray.shutdown()

    def _connect(self) -> None:
        quiet = {"logging_level": "warning", "log_to_driver": False}
        try:
            if self._address is None:
                cpus = max(self._workers, os.cpu_count() or 1)
                self._ray.init(num_cpus=cpus, include_dashboard=False, **quiet)
            else:
                self._ray.init(address=self._address, **quiet)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise DatasetError(f"no Ray cluster at {self._address!r}: {error}") from error

    def _makers(self, plan: ExportPlan, count: int) -> list[Any]:
        threads = max(1, (os.cpu_count() or 1) // count) if self._address is None else 1
        made = self._ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=MOST_TRIES - 1)(
            ShardMaker
        )
        return [made.remote(self._recipe, plan, self._backend, threads) for _ in range(count)]

    def _make_all(
        self,
        makers: Sequence[Any],
        clips: Sequence[PlannedClip],
        folder: Path,
        on_frames: Callable[[int], None],
    ) -> None:
        """Give each actor one clip at a time, the next when it has made it. Actors that the cluster
        has no room for get none, and are not waited for."""
        ray, left = self._ray, list(reversed(clips))
        at_work: dict[Any, tuple[Any, PlannedClip | None]]
        at_work = {actor.is_ready.remote(): (actor, None) for actor in makers}
        while left or any(clip is not None for _, clip in at_work.values()):
            [done], _ = ray.wait(list(at_work), num_returns=1)
            actor, clip = at_work.pop(done)
            try:
                made = ray.get(done)
            except ray.exceptions.RayActorError as error:
                what = "a worker" if clip is None else f"clip {clip.name}"
                raise DatasetError(
                    f"{what}: its actor died {MOST_TRIES} times ({error})"
                ) from error
            if left:
                following = left.pop()
                at_work[actor.make_archive.remote(following)] = (actor, following)
            if clip is not None:
                _unpack(made, folder / clip.name)
                on_frames(len(clip.times_us))


def _unpack(archive: bytes, folder: Path) -> None:
    """The files of a clip; the folder appears when it is whole."""
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(partial, filter="data")
    partial.rename(folder)
