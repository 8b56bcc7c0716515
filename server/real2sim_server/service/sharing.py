"""What a worker shares with others by a store of objects: it puts there what it has made, and takes
out what others have, beside its sessions: no step ever waits for that store."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import TypeVar

import structlog

from real2sim_proto import ErrorCode
from real2sim_proto.jobs import JobState

from .http.problems import ServiceError
from .library.assets import ASSET_SUFFIX, AssetLibrary
from .library.scenes import BUNDLE_SUFFIX, SceneCatalog
from .objects.object_store import ObjectStoreError
from .objects.shared_bundles import BundleFolders, BundleLog, BundleRow, SharedBundle
from .storage.job_log import JobLog
from .storage.store import StoreError

T = TypeVar("T")

LOOK_S = 2.0
"""Between looks for what is new, here and elsewhere."""
SWEEP_S = 3600.0
"""Between looks for objects that nobody needs."""

log = structlog.get_logger(__name__)


class Sharing:
    """Scenes, assets and files of jobs that workers on one store have in common.

    Belongs to the event loop; what waits for the store of objects has threads of its own.

    Args:
        folders: of bundles, and the store of objects.
        bundle_log: what there is.
        job_log: says which jobs have left something.
        catalog, assets: what there is here.

    Attributes:
        listen: makes a function that waits for word from other workers, for some seconds at most.
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
        """Shares for the length of the block."""
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
        """Fetch what another worker has shared; whether there is such a thing.

        Raises:
            ServiceError: STORAGE_UNAVAILABLE: the store of objects does not give it.
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
        """Where anybody may fetch a file for a while; None where it is not in the store of objects,
        or that gives no such addresses.

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
        """Share something no more; its objects go once nobody has needed them for a day."""
        if kind == "asset":
            await self._log.mark_deleted(kind, name)
        else:
            await self._log.remove(kind, name)

    async def look(self) -> None:
        """Put what is new here into the store of objects, and take new assets out of it.

        Raises:
            StoreError: of the database.
            ObjectStoreError: of the store of objects.
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
                pass  # it tells of its trouble itself
            except (ObjectStoreError, OSError) as error:
                if not self._in_trouble:
                    log.error("store of objects in trouble", reason=str(error))
                self._in_trouble = True
            except Exception:
                log.exception("sharing failed")
            await pause(LOOK_S)

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(SWEEP_S)
            try:
                rows = [row for row in await self._log.all() if not row.deleted]
                bundles = [SharedBundle.of_document(r.kind, r.name, r.document) for r in rows]
                wanted = {file.digest for bundle in bundles for file in bundle.files}
                if gone := await self._on_thread(partial(self._folders.sweep, wanted)):
                    log.info("objects removed that nobody needs", objects=gone)
            except (StoreError, ObjectStoreError) as error:
                log.warning("sweeping of objects put off", reason=str(error))

    async def _put(self, kind: str, name: str, folder: Path) -> None:
        bundle = await self._on_thread(partial(self._folders.put, kind, name, folder))
        row = BundleRow(kind, name, bundle.content, bundle.document(), bundle.bytes)
        if await self._log.add(row):
            log.info("bundle shared", kind=kind, name=name, bytes=bundle.bytes)

    async def _follow_assets(self) -> None:
        """All assets of the fleet are here, since an edit must not wait for them; those that were
        deleted elsewhere go."""
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
        """Whole bundles that were made here and are not on record."""
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
    """Whether a folder is there, and older than a row."""
    try:
        return folder.stat().st_mtime * 1e6 < row.created_us
    except OSError:
        return False


def _unavailable(what: str, error: ObjectStoreError) -> ServiceError:
    return ServiceError(
        ErrorCode.STORAGE_UNAVAILABLE,
        f"{what} lies in the store of objects, which does not give it: {error}",
        hint="send it again after Retry-After seconds",
    )
