"""The scenes of a worker: the catalogue of its folder, the cache in memory, and their budgets."""

from __future__ import annotations

import asyncio
import os
import re
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.base import ID_PATTERN
from real2sim_proto.scenes import WITHOUT_SCENES, SceneState

from ...render import scene_levels_bytes
from ...scene import BundleError, Scene, SceneError
from ...scene.io import SceneSummary, load_scene, read_scene_summary
from ..engine import Engine, Priority
from ..http.responses import ServiceError
from ..shared_objects import mark_used

# Budgets: memory for loaded scenes and assets, disk space for the worker's folders.


@dataclass(frozen=True)
class IdleItem:
    """An unused item in memory.

    Attributes:
        used_at: time of the last use, monotonic clock [s].
        nbytes: size of the item.
        drop: drops the item; returns the bytes that become free, immediately or soon.
    """

    used_at: float
    nbytes: int
    drop: Callable[[], int]


class MemoryHolder(Protocol):
    """A user of the memory budget. Both methods are called on any thread."""

    @property
    def held_bytes(self) -> int:
        """Memory of all loaded and loading items."""

    def idle(self) -> Sequence[IdleItem]:
        """Items that can be dropped."""


class MemoryBudget:
    """Memory budget of all holders. Thread-safe.

    Args:
        total_bytes: the budget.
    """

    def __init__(self, total_bytes: int) -> None:
        self.total_bytes = total_bytes
        self._holders: list[MemoryHolder] = []
        self._lock = threading.Lock()

    def add(self, holder: MemoryHolder) -> None:
        """Count the memory of ``holder``."""
        self._holders.append(holder)

    @property
    def free_bytes(self) -> int:
        """Free bytes; negative if items in use exceed the budget."""
        return self.total_bytes - sum(holder.held_bytes for holder in self._holders)

    def make_room(self, what: str, needed: int, *, reserve: Callable[[], None]) -> None:
        """Drop idle items, least recently used first, until ``needed`` bytes fit.

        Args:
            what: name for messages, such as ``scene 'street'``.
            needed: bytes.
            reserve: makes the holder count these bytes; called before another caller can use the
                space.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        if needed > self.total_bytes:
            raise _out_of_memory(
                f"{what} needs {needed} bytes, the budget is {self.total_bytes}",
                hint="raise REAL2SIM_SCENE_MEMORY_BYTES, or thin it out",
                needed=needed,
                free=self.total_bytes,
            )
        with self._lock:
            free = self.free_bytes
            idle = sorted(
                (item for holder in self._holders for item in holder.idle()),
                key=lambda item: item.used_at,
            )
            if needed <= free + sum(item.nbytes for item in idle):
                for item in idle:
                    if needed <= free:
                        break
                    free += item.drop()
            if needed > free:
                raise _out_of_memory(
                    f"{what} needs {needed} bytes; of the budget of {self.total_bytes} all but "
                    f"{free} are taken by scenes and assets that are in use",
                    hint="close sessions on other scenes, or raise REAL2SIM_SCENE_MEMORY_BYTES",
                    needed=needed,
                    free=free,
                )
            reserve()


def _out_of_memory(detail: str, *, hint: str, needed: int, free: int) -> ServiceError:
    extra = {"needed_bytes": needed, "free_bytes": free}
    return ServiceError(ErrorCode.OUT_OF_MEMORY, detail, hint=hint, extra=extra)


# --- Disk ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quota:
    """Limits of one folder. All content counts, regardless of its origin.

    Attributes:
        folder: the folder; it need not exist.
        what: its kind of entries for messages, such as ``assets``.
        max_entries: maximum number of entries; hidden ones do not count.
        max_bytes: maximum size of all files below it.
        setting: setting that the operator can raise, such as ``ASSETS_QUOTA``.
        remedy: how to free space.
    """

    folder: Path
    what: str
    max_entries: int
    max_bytes: int
    setting: str
    remedy: str

    def check(self, *, added_bytes: int = 0, entries: int | None = None) -> None:
        """Refuse another entry if a limit is reached. Reads the folder, which is slow.

        Args:
            added_bytes: size of the new entry, if known.
            entries: number of entries; default: counted in the folder.

        Raises:
            ServiceError: QUOTA_EXCEEDED.
        """
        found, used = folder_usage(self.folder)
        entries = found if entries is None else entries
        if entries >= self.max_entries:
            raise self._exceeded(
                f"there are {entries} {self.what}; allowed are {self.max_entries}", self.setting
            )
        if used + added_bytes > self.max_bytes or used >= self.max_bytes:
            raise self._exceeded(
                f"{self.what} take {used} bytes of disk and this one at least {added_bytes} more; "
                f"allowed are {self.max_bytes}",
                f"{self.setting}_BYTES",
            )

    def _exceeded(self, detail: str, setting: str) -> ServiceError:
        return ServiceError(
            ErrorCode.QUOTA_EXCEEDED,
            detail,
            hint=f"{self.remedy}, or let the operator raise REAL2SIM_{setting}",
        )


def folder_usage(folder: Path) -> tuple[int, int]:
    """Number of entries of a folder, and bytes of their files; hidden entries are incomplete."""
    entries = [entry for entry in _scan(folder) if not entry.name.startswith(".")]
    return len(entries), sum(map(_size, entries))


def _size(entry: os.DirEntry[str]) -> int:
    try:
        if entry.is_dir(follow_symlinks=False):
            return sum(map(_size, _scan(entry.path)))
        return entry.stat(follow_symlinks=False).st_size
    except OSError:  # it has been removed in the meantime
        return 0


def _scan(folder: str | Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as found:
            return list(found)
    except OSError:
        return []


BUNDLE_SUFFIX = ".r2s"
SCENE_DOCUMENT = "scene.json"
_IDENTIFIER = re.compile(ID_PATTERN)


@dataclass(frozen=True)
class Listing:
    """A bundle folder.

    Attributes:
        name: name of the scene in URLs.
        path: its folder.
        summary: its content; None if it is broken.
        reason: why it is broken, or None.
    """

    name: str
    path: Path
    summary: SceneSummary | None
    reason: str | None


Fingerprint = tuple[tuple[str, int, int], ...]


class SceneCatalog:
    """Lists the scene folder; only reads bundles that changed since the last call.

    Args:
        folder: folder of bundles; it need not exist.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[Path, tuple[Fingerprint, Listing]] = {}
        self._lock = threading.Lock()

    def scan(self) -> dict[str, Listing]:
        """All bundles by scene name, sorted."""
        with self._lock:
            return self._scan()

    def _scan(self) -> dict[str, Listing]:
        listings: dict[str, Listing] = {}
        seen: dict[Path, tuple[Fingerprint, Listing]] = {}
        for path in self._candidates():
            entry = self._look(path)
            seen[path] = entry
            listing = entry[1]
            if listing.name in listings:
                other = listings[listing.name].path.name
                reason = f"{path.name!r} and {other!r} are the same scene name; rename one"
                listing = Listing(path.name, path, None, reason)
            listings[listing.name] = listing
        self._known = seen
        return dict(sorted(listings.items()))

    def mark_broken(self, listing: Listing, reason: str) -> None:
        """Mark a bundle that failed to load, until it changes."""
        broken = Listing(listing.name, listing.path, None, reason)
        with self._lock:
            self._known[listing.path] = (_fingerprint(listing.path), broken)

    def public(self, error: Exception) -> str:
        """The error's message without the folder's path on this machine."""
        return str(error).replace(f"{self.folder}/", "")

    def _candidates(self) -> Iterator[Path]:
        if not self.folder.is_dir():
            return
        for path in sorted(self.folder.iterdir()):
            # Hidden folders are bundles being written.
            if path.name.startswith(".") or not path.is_dir():
                continue
            if path.suffix == BUNDLE_SUFFIX or (path / SCENE_DOCUMENT).exists():
                yield path

    def _look(self, path: Path) -> tuple[Fingerprint, Listing]:
        fingerprint = _fingerprint(path)
        known = self._known.get(path)
        if known is not None and known[0] == fingerprint:
            return known
        return fingerprint, self._read(path)

    def _read(self, path: Path) -> Listing:
        name = path.name.removesuffix(BUNDLE_SUFFIX)
        try:
            if not _IDENTIFIER.match(name):
                raise SceneError(f"{name!r} cannot be a scene name; rename it to {ID_PATTERN}")
            summary = read_scene_summary(path)
            _check_sizes(path, summary)
        except (SceneError, OSError) as error:
            return Listing(name, path, None, self.public(error))
        return Listing(name, path, summary, None)


def bundle_folder(folder: Path, name: str) -> Path:
    """Path of a new bundle."""
    return folder / f"{name}{BUNDLE_SUFFIX}"


def _fingerprint(path: Path) -> Fingerprint:
    """Names, sizes and times of a bundle's files, to detect changes. Hidden files are excluded."""
    try:
        entries = sorted(p for p in path.iterdir() if not p.name.startswith("."))
        stats = [(p.name, p.stat()) for p in entries]
    except OSError:
        return ()
    return tuple((name, s.st_size, s.st_mtime_ns) for name, s in stats)


def _check_sizes(path: Path, summary: SceneSummary) -> None:
    found = sum(p.stat().st_size for p in path.glob("*.safetensors"))
    if found < summary.nbytes:
        raise SceneError(
            f"{path}: cut short: scene.json lists {summary.nbytes} bytes of tensors, the folder "
            f"has {found}; copy the bundle again"
        )


# --- Cache ---------------------------------------------------------------------------------------

T = TypeVar("T")

log = structlog.get_logger(__name__)


@dataclass
class _Resident:
    scene: Scene
    summary: SceneSummary
    pins: int = 0
    used_at: float = 0.0


class SceneCache:
    """Scenes of the scene folder, loaded on demand and evicted if memory is short.

    All users share one scene object. A session pins its scene; unpinned scenes are evicted in
    least-recently-used order. Call methods on the event loop, except where noted.

    Args:
        catalog: the scene folder.
        engine: uploads loaded scenes to the device.
        budget: memory budget shared with other holders.
        device: device of their tensors.
        on_load: called with the duration of each load [s].

    Attributes:
        fetch: fetches a missing scene from another worker; returns whether it exists.
    """

    def __init__(
        self,
        catalog: SceneCatalog,
        engine: Engine,
        *,
        budget: MemoryBudget,
        device: str = "cpu",
        on_load: Callable[[float], None] | None = None,
    ) -> None:
        self.catalog = catalog
        self.budget = budget
        self.device = device
        self._engine = engine
        self._on_load = on_load
        self.fetch: Callable[[str], Awaitable[bool]] | None = None
        self._listings: dict[str, Listing] = {}
        self._resident: dict[str, _Resident] = {}
        self._loading: dict[str, asyncio.Task[Scene]] = {}
        self._reserved: dict[str, int] = {}
        # Reading and hashing bundles would block sessions on the engine, and all requests on the
        # event loop. One thread, because disks and memory are fastest with one reader.
        self._loop: asyncio.AbstractEventLoop | None = None
        self._loop_thread = 0
        budget.add(self)
        self._disk = ThreadPoolExecutor(1, thread_name_prefix="scenes")

    def close(self) -> None:
        """Drop all scenes and end the disk thread."""
        self._disk.shutdown(cancel_futures=True)
        self._resident.clear()

    async def on_disk_thread(self, fn: Callable[[], T]) -> T:
        """Run ``fn()`` on the thread that reads and writes bundles."""
        return await asyncio.get_running_loop().run_in_executor(self._disk, fn)

    # --- queries ----------------------------------------------------------------------------

    async def refresh(self) -> dict[str, Listing]:
        """List the scene folder; all scenes by name."""
        self._listings = await asyncio.to_thread(self.catalog.scan)
        return self._listings

    async def listing(self, name: str) -> Listing:
        """The bundle with that name.

        Raises:
            ServiceError: UNKNOWN_SCENE, with the available names.
        """
        known = self._listings.get(name) or (await self.refresh()).get(name)
        if known is None and self.fetch is not None and await self.fetch(name):
            known = (await self.refresh()).get(name)
        if known is None:
            names = ", ".join(list(self._listings)[:20])
            raise ServiceError(
                ErrorCode.UNKNOWN_SCENE,
                f"no scene {name!r}; there are: {names or 'none'}",
                hint="GET /v1/scenes lists them; POST /v1/scenes imports one"
                if names
                else WITHOUT_SCENES,
            )
        return known

    async def summary(self, name: str) -> SceneSummary:
        """Summary of a scene, from memory if it is loaded, else from the bundle on disk.

        A bundle that was replaced on disk takes effect at the next load.

        Raises:
            ServiceError: UNKNOWN_SCENE or SCENE_BROKEN.
        """
        if (resident := self._resident.get(name)) is not None:
            return resident.summary
        listing = await self.listing(name)
        if listing.summary is None:
            # The bundle may have been repaired since.
            listing = (await self.refresh()).get(name, listing)
        if listing.summary is None:
            raise _broken(name, listing.reason)
        return listing.summary

    def state(self, name: str) -> SceneState:
        """Loading state of a listed scene."""
        if name in self._resident:
            return SceneState.RESIDENT
        if name in self._loading:
            return SceneState.LOADING
        listing = self._listings.get(name)
        return SceneState.BROKEN if listing and listing.reason else SceneState.AVAILABLE

    def counters(self) -> dict[SceneState, Callable[[], float]]:
        """For each state, a function that counts the scenes in it."""

        def count(state: SceneState) -> float:
            return sum(self.state(name) is state for name in list(self._listings))

        return {state: partial(count, state) for state in SceneState}

    @property
    def resident_names(self) -> list[str]:
        """Scenes in memory."""
        return sorted(self._resident)

    @property
    def resident_bytes(self) -> int:
        """Memory of all resident scenes."""
        return sum(r.scene.nbytes for r in list(self._resident.values()))

    @property
    def held_bytes(self) -> int:
        """Memory of all scenes that are resident or loading [bytes]."""
        return self.resident_bytes + sum(list(self._reserved.values()))

    def idle(self) -> list[IdleItem]:
        """Scenes that no session pins. Thread-safe, including the returned items."""
        return [
            IdleItem(r.used_at, nbytes, partial(self._drop, name, nbytes))
            for name, r in list(self._resident.items())
            if not r.pins
            for nbytes in (r.scene.nbytes + scene_levels_bytes(r.scene),)
        ]

    # --- use --------------------------------------------------------------------------------

    async def get(self, name: str) -> Scene:
        """The scene, loaded if necessary. A reference keeps it alive; it is not pinned.

        Raises:
            ServiceError: UNKNOWN_SCENE, SCENE_BROKEN, or OUT_OF_MEMORY.
        """
        return (await self._ensure(name)).scene

    async def pin(self, name: str) -> Scene:
        """The scene, held in memory until :meth:`unpin`. Raises like :meth:`get`."""
        resident = await self._ensure(name)
        resident.pins += 1
        return resident.scene

    def unpin(self, name: str) -> None:
        """Release one pin."""
        resident = self._resident[name]
        if resident.pins <= 0:
            raise RuntimeError(f"scene {name!r} is not pinned")
        resident.pins -= 1
        resident.used_at = time.monotonic()

    @asynccontextmanager
    async def pinned(self, name: str) -> AsyncIterator[Scene]:
        """The scene, in memory during the block. Raises like :meth:`get`."""
        scene = await self.pin(name)
        try:
            yield scene
        finally:
            self.unpin(name)

    async def unload(self, name: str) -> None:
        """Remove the scene from memory; no effect if it is not loaded.

        Raises:
            ServiceError: UNKNOWN_SCENE, or SCENE_IN_USE while sessions pin it.
        """
        await self.listing(name)
        resident = self._resident.get(name)
        if resident is None:
            return
        if resident.pins:
            raise ServiceError(
                ErrorCode.SCENE_IN_USE,
                f"{resident.pins} sessions use scene {name!r}",
                hint="close them first: DELETE /v1/sessions/{id}",
            )
        self._forget(name)

    # --- inside -----------------------------------------------------------------------------

    async def _ensure(self, name: str) -> _Resident:
        while (resident := self._resident.get(name)) is None:
            task = self._loading.get(name)
            if task is None:
                summary = await self.summary(name)
                if name in self._resident or name in self._loading:
                    continue
                self._loop = asyncio.get_running_loop()
                self._loop_thread = threading.get_ident()
                self.budget.make_room(
                    f"scene {name!r}",
                    summary.nbytes,
                    reserve=partial(self._reserved.__setitem__, name, summary.nbytes),
                )
                task = asyncio.create_task(self._load(name, summary), name=f"load {name}")
                # Retrieve the outcome even if all waiters have left.
                task.add_done_callback(lambda t: t.cancelled() or t.exception())
                self._loading[name] = task
            # Others may wait for the same load; a cancelled waiter must not cancel it.
            await asyncio.shield(task)
        resident.used_at = time.monotonic()
        return resident

    async def _load(self, name: str, summary: SceneSummary) -> Scene:
        started = time.monotonic()
        try:
            await self.on_disk_thread(partial(mark_used, summary.path))
            scene = await self.on_disk_thread(lambda: load_scene(summary.path))
            scene = await self._engine.call(
                scene.to, self.device, label="load", priority=Priority.BULK
            )
        except BundleError as error:
            reason = self.catalog.public(error)
            listing = Listing(name, summary.path, None, reason)
            self._listings = self._listings | {name: listing}
            await asyncio.to_thread(self.catalog.mark_broken, listing, reason)
            log.warning("scene broken", scene=name, reason=reason)
            raise _broken(name, reason) from error
        finally:
            self._reserved.pop(name, None)
            self._loading.pop(name, None)
        self._resident[name] = _Resident(scene, summary, used_at=time.monotonic())
        seconds = time.monotonic() - started
        if self._on_load:
            self._on_load(seconds)
        log.info("scene loaded", scene=name, bytes=scene.nbytes, seconds=round(seconds, 3))
        return scene

    def _drop(self, name: str, nbytes: int) -> int:
        """Drop an idle scene; from other threads this runs on the event loop."""
        loop = self._loop
        if loop is None or loop.is_closed():
            return 0
        if threading.get_ident() == self._loop_thread:
            self._forget_idle(name)
        else:
            loop.call_soon_threadsafe(self._forget_idle, name)
        return nbytes

    def _forget_idle(self, name: str) -> None:
        resident = self._resident.get(name)
        if resident is not None and not resident.pins:
            self._forget(name)

    def _forget(self, name: str) -> None:
        del self._resident[name]
        log.info("scene unloaded", scene=name)


def _broken(name: str, reason: str | None) -> ServiceError:
    return ServiceError(
        ErrorCode.SCENE_BROKEN,
        f"scene {name!r} cannot be read: {reason}",
        hint="copy or import the bundle again; the worker detects it automatically",
    )
