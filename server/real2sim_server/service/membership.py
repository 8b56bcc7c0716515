"""A worker in a fleet: its lease, shared objects, prewarmed scenes, reports to the proxy."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import JobState

from .accounts import Accounts
from .http.responses import ServiceError
from .library.assets import ASSET_SUFFIX, AssetLibrary
from .library.scenes import BUNDLE_SUFFIX, SceneCache, SceneCatalog
from .sessions import Sessions
from .shared_objects import BundleFolders, BundleLog, BundleRow, ObjectStoreError, SharedBundle
from .storage.connection import StoreError
from .storage.fleet import Leases, WorkerRow
from .storage.job_log import JobLog

# Sharing: uploads this worker's bundles and files to the object store and fetches those of others.
# Steps never wait for that store.

T = TypeVar("T")

SHARING_PERIOD_S = 2.0
"""Interval of checks for new items, here and elsewhere [s]."""
SWEEP_S = 3600.0
"""Interval of checks for unused objects [s]."""

log = structlog.get_logger(__name__)


class Sharing:
    """Scenes, assets and job files shared by workers with one store.

    For use on the event loop; calls to the object store run on separate threads.

    Args:
        folders: folders of bundles, and the object store.
        bundle_log: lists shared bundles.
        job_log: lists jobs with files.
        catalog, assets: local scenes and assets.

    Attributes:
        listen: creates a function that waits for notifications of other workers, with a timeout
            [s].
    """

    def __init__(
        self,
        folders: BundleFolders,
        bundle_log: BundleLog,
        job_log: JobLog,
        *,
        catalog: SceneCatalog,
        assets: AssetLibrary,
    ) -> None:
        self._folders = folders
        self._log = bundle_log
        self._jobs = job_log
        self._catalog = catalog
        self._assets = assets
        self._known: dict[tuple[str, str], BundleRow] = {}
        self._state: tuple[int, int] | None = None
        self._in_trouble = False
        self.listen: Callable[[], Callable[[float], Awaitable[None]]] = lambda: asyncio.sleep
        self._threads = ThreadPoolExecutor(2, thread_name_prefix="objects")

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Share during the block."""
        tasks = [asyncio.create_task(self._share(), name="sharing")]
        tasks.append(asyncio.create_task(self._sweep(), name="sweeping objects"))
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._threads.shutdown(wait=False, cancel_futures=True)

    async def take_out(self, kind: str, name: str) -> bool:
        """Fetch an item that another worker has shared; returns whether it exists.

        Raises:
            ServiceError: STORAGE_UNAVAILABLE if the object store fails.
        """
        row = await self._log.get(kind, name)
        if row is None or row.deleted:
            return False
        bundle = SharedBundle.of_document(kind, name, row.document)
        try:
            await self._on_thread(partial(self._folders.take_out, bundle))
        except ObjectStoreError as error:
            raise _unavailable(f"{kind} {name!r}", error) from error
        return True

    async def signed_url(self, kind: str, name: str, file: str, *, seconds: float) -> str | None:
        """A temporary public URL of a file; None if it is not in the object store, or if the store
        does not support such URLs.

        Raises:
            ServiceError: STORAGE_UNAVAILABLE.
        """
        row = await self._log.get(kind, name)
        if row is None or row.deleted:
            return None
        found = SharedBundle.of_document(kind, name, row.document).files
        for digest in (one.digest for one in found if one.path == file):
            sign = partial(self._folders.objects.signed_url, digest, seconds)
            try:
                return await self._on_thread(sign)
            except ObjectStoreError as error:
                raise _unavailable(f"{kind} {name!r}", error) from error
        return None

    async def forget(self, kind: str, name: str) -> None:
        """Stop sharing an item; its objects are deleted after a day without use."""
        if kind == "asset":
            await self._log.mark_deleted(kind, name)
        else:
            await self._log.remove(kind, name)

    async def look(self) -> None:
        """Upload new local items to the object store, and download new assets.

        Raises:
            StoreError: from the database.
            ObjectStoreError: from the object store.
        """
        state = await self._log.state()
        if state != self._state:
            self._known = {(row.kind, row.name): row for row in await self._log.all()}
            self._state = state
            await self._follow_assets()
        for kind, name, folder in await self._on_thread(self._unshared):
            if kind == "job":
                info = await self._jobs.get(name)
                if info is None or info.state is not JobState.SUCCEEDED:
                    continue
            await self._put(kind, name, folder)

    # --- inside -----------------------------------------------------------------------------

    async def _share(self) -> None:
        pause = self.listen()
        while True:
            try:
                await self.look()
                self._in_trouble = False
            except StoreError:
                pass  # the store logs its own errors
            except (ObjectStoreError, OSError) as error:
                if not self._in_trouble:
                    log.error("store of objects in trouble", reason=str(error))
                self._in_trouble = True
            except Exception:
                log.exception("sharing failed")
            await pause(SHARING_PERIOD_S)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            try:
                rows = [row for row in await self._log.all() if not row.deleted]
                bundles = [SharedBundle.of_document(r.kind, r.name, r.document) for r in rows]
                wanted = {file.digest for bundle in bundles for file in bundle.files}
                if gone := await self._on_thread(partial(self._folders.sweep, wanted)):
                    log.info("removed unused objects", objects=gone)
            except (StoreError, ObjectStoreError) as error:
                log.warning("sweeping of objects put off", reason=str(error))

    async def _put(self, kind: str, name: str, folder: Path) -> None:
        bundle = await self._on_thread(partial(self._folders.put, kind, name, folder))
        row = BundleRow(kind, name, bundle.content, bundle.document(), bundle.bytes)
        if await self._log.add(row):
            log.info("bundle shared", kind=kind, name=name, bytes=bundle.bytes)

    async def _follow_assets(self) -> None:
        """Download all assets of the fleet ahead of edits, and delete assets that were deleted
        elsewhere."""
        rows = [row for (kind, _), row in self._known.items() if kind == "asset"]
        for row in rows:
            if not row.deleted:
                bundle = SharedBundle.of_document("asset", row.name, row.document)
                await self._on_thread(partial(self._folders.take_out, bundle))
            elif _made_before(self._assets.bundle(row.name), row):
                with contextlib.suppress(ServiceError, OSError):
                    await self._on_thread(partial(self._remove_asset, row.name))

    def _remove_asset(self, asset_id: str) -> None:
        with self._assets.removing(asset_id):
            self._assets.remove(asset_id)

    def _unshared(self) -> list[tuple[str, str, Path]]:
        """Complete local bundles that are not yet listed."""
        listed = [("scene", listing) for listing in self._catalog.scan().values()]
        whole = {listing.path for _, listing in listed if listing.reason is None}
        whole |= {self._assets.bundle(info.asset_id) for info in self._assets.list()}
        found = []
        suffixes = {"scene": BUNDLE_SUFFIX, "asset": ASSET_SUFFIX, "job": ""}
        for kind, suffix in suffixes.items():
            for path in self._folders.own(kind):
                name = path.name.removesuffix(suffix)
                row = self._known.get((kind, name))
                is_new = row is None or (row.deleted and not _made_before(path, row))
                if is_new and (kind == "job" or path in whole):
                    found.append((kind, name, path))
        return found

    async def _on_thread(self, fn: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, fn)


def _made_before(folder: Path, row: BundleRow) -> bool:
    """Whether a folder exists, and is older than a row."""
    try:
        return folder.stat().st_mtime * 1e6 < row.created_us
    except OSError:
        return False


def _unavailable(what: str, error: ObjectStoreError) -> ServiceError:
    return ServiceError(
        ErrorCode.STORAGE_UNAVAILABLE,
        f"{what} is in the object store, which failed to return it: {error}",
        hint="send it again after Retry-After seconds",
    )


RENEWALS = 4
"""Renewals per lease duration; some of them may be late."""


class Membership:
    """Renews a worker's lease while it runs.

    Args:
        leases: leases of the worker.
        sessions: its sessions under these leases.
        seconds: duration of a lease.
        document: creates the status document for the fleet; called for each renewal.
        accounts: receives the usage reported by other workers.
    """

    def __init__(
        self,
        leases: Leases,
        sessions: Sessions,
        *,
        seconds: float,
        document: Callable[[], Mapping[str, Any]],
        accounts: Accounts,
    ) -> None:
        self._leases = leases
        self._sessions = sessions
        self._seconds = seconds
        self._document = document
        self._accounts = accounts
        self._renewed = 0.0
        self._left = False

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Hold the lease during the block.

        Raises:
            StoreError: the first lease cannot be obtained.
        """
        await self._renew()
        renewing = asyncio.create_task(self._renew_for_ever(), name="lease")
        try:
            yield
        finally:
            renewing.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await renewing
            if not self._left:
                await self.leave()

    async def tell(self) -> None:
        """Publish the worker's status immediately."""
        with contextlib.suppress(StoreError):
            await self._renew()

    async def leave(self) -> None:
        """Give up the lease; other workers may take over the sessions immediately."""
        self._left = True
        with contextlib.suppress(StoreError):
            await self._leases.give_up(self._document())

    async def _renew_for_ever(self) -> None:
        while not self._left:
            await asyncio.sleep(self._seconds / RENEWALS)
            try:
                await self._renew()
            except StoreError:
                # The store logs its own failures. While it fails, others cannot take over either.
                continue
            except Exception:
                # Any error: without its lease the worker would lose its sessions.
                log.exception("renewing the lease failed")

    async def _renew(self) -> None:
        if self._left:
            return
        asked = time.monotonic()
        await self._leases.renew(self._document())
        await self._hear_of_others()
        lapsed = self._renewed and time.monotonic() - self._renewed > self._seconds
        self._renewed = asked
        if lapsed:
            log.warning("the lease had run out", seconds=self._seconds)
            await self._sessions.drop_lost()

    async def _hear_of_others(self) -> None:
        """Read other workers' account usage, if it is limited."""
        if self._accounts.counts:
            rows = await self._leases.workers()
            others = [w for w in rows if w.alive and w.worker_id != self._leases.worker_id]
            self._accounts.take_word(w.document.get("held", {}) for w in others)


# --- Agent check ---------------------------------------------------------------------------------

# Reports the worker's readiness in the format of HAProxy's ``agent-check``. A draining worker keeps
# its sessions and gets no new ones. The weight does not follow the load, because that would move
# scenes between workers; the proxy's bounded hashing balances the load.


@dataclass(frozen=True)
class Willingness:
    """Readiness of a worker.

    Attributes:
        ready: whether it accepts new work.
        full: whether the maximum number of sessions is open.
        handed_over: whether other workers have its sessions: no more requests may be sent to it.
    """

    ready: bool
    full: bool
    handed_over: bool


class Agent:
    """Answers every connection with one line, and closes it.

    Args:
        willingness: returns the worker's readiness; called for each answer.
        weight: weight of the worker, in percent of its weight in the proxy's configuration.
    """

    def __init__(self, willingness: Callable[[], Willingness], *, weight: int) -> None:
        self._willingness = willingness
        self._weight = weight

    def word(self) -> str:
        """The line: ``up ready 100%``, ``drain``, or ``down``."""
        found = self._willingness()
        if found.handed_over:
            return "down"
        if not found.ready or found.full:
            return "up drain"
        return f"up ready {self._weight}%"

    @contextlib.asynccontextmanager
    async def running(self, host: str, port: int) -> AsyncIterator[int]:
        """Listen during the block.

        Args:
            host: address to listen on.
            port: 0 uses a free one.

        Yields:
            The port.

        Raises:
            OSError: the address is in use, or does not belong to this machine.
        """
        server = await asyncio.start_server(self._answer, host, port)
        try:
            yield server.sockets[0].getsockname()[1]
        finally:
            server.close()
            await server.wait_closed()

    async def _answer(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            writer.write(f"{self.word()}\n".encode())
            await writer.drain()
            writer.close()
            await writer.wait_closed()


# --- Prewarming ----------------------------------------------------------------------------------

# The proxy sends new sessions to the worker that has their scene, until that worker has 1.5 times
# as many sessions as the others. Prewarming loads the scene on the next worker before that.

LOOK_S = 5.0
"""Interval of checks for the fleet's hot scenes [s]."""


class Prewarming:
    """Loads scenes that are in demand on other workers, when this worker is next in order.

    Args:
        leases: list the workers.
        scene_cache: receives the scenes; they are evicted if memory is short.
        worker_id: id of this worker.
        hot: sessions of a scene, over all workers, from which two workers load it.
    """

    def __init__(
        self, leases: Leases, scene_cache: SceneCache, *, worker_id: str, hot: int
    ) -> None:
        self._leases = leases
        self._scene_cache = scene_cache
        self._worker_id = worker_id
        self._hot = hot

    async def run(self) -> None:
        """Check periodically, until cancelled."""
        while self._hot:
            await asyncio.sleep(LOOK_S)
            try:
                await self.look()
            except StoreError:
                continue  # the store logs its own errors
            except ServiceError as error:
                log.info("scene not loaded ahead", reason=str(error))

    async def look(self) -> None:
        """Load the scenes assigned to this worker.

        Raises:
            StoreError: from the database.
            ServiceError: a scene cannot be loaded.
        """
        for scene in loads_of(self._worker_id, await self._leases.workers(), hot=self._hot):
            log.info("scene loaded ahead", scene=scene)
            await self._scene_cache.get(scene)


def loads_of(worker_id: str, workers: Sequence[WorkerRow], *, hot: int) -> list[str]:
    """Hot scenes that only one worker has, and that ``worker_id`` should load.

    All workers compute the same result from the reported statuses: the first worker without the
    scene, in an order that depends on the scene.
    """
    living = {w.worker_id: w.document for w in workers if w.alive and takes_work(w.document)}
    driven: Counter[str] = Counter()
    for document in living.values():
        driven.update(document.get("scene_sessions", {}))
    found = []
    for scene in sorted(scene for scene, many in driven.items() if many >= hot):
        without = [name for name, about in living.items() if scene not in about.get("scenes", ())]
        if len(living) - len(without) == 1 and without:
            first = min(without, key=lambda name: _order(scene, name))
            found += [scene] * (first == worker_id)
    return found


def _order(scene: str, worker_id: str) -> bytes:
    return hashlib.sha256(f"{scene} {worker_id}".encode()).digest()


def takes_work(document: Mapping[str, Any]) -> bool:
    """Whether a worker with this status accepts new sessions and jobs."""
    return bool(document.get("ready")) and not document.get("draining")
