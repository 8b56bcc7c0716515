"""What a worker does for itself: leftovers of killed runs go, and what is kept stays in limits."""

from __future__ import annotations

import asyncio
from pathlib import Path

import structlog

from .._files import sweep_leftovers
from ..settings import Settings
from .clock import now_us
from .jobs.jobs import Jobs
from .sessions import Sessions
from .sessions.shared_memory import sweep_segments
from .storage.backup import RESTORING
from .storage.errors import StoreError
from .storage.retention import DAY_US, Retention, RetentionLimits
from .storage.store import Store

PERIOD_S = 3600.0
UPLOADS = ".upload-"
OTHERS_UNUSED_S = 3600.0
"""What may belong to another process counts as left behind when nobody has written for so long."""

log = structlog.get_logger(__name__)


class Upkeep:
    """Keeps the folders and the store of a worker in order, at its start and every hour.

    Args:
        settings: folders and limits.
        store: open while this runs.
        jobs: whose old ones go, with their files.
        sessions: those in memory are not ended.
    """

    def __init__(self, settings: Settings, store: Store, jobs: Jobs, sessions: Sessions) -> None:
        self._settings = settings
        self._jobs = jobs
        self._sessions = sessions
        limits = RetentionLimits(settings.session_retention_days, settings.store_max_bytes)
        self._retention = Retention(store, limits, worker_id=settings.worker_id)

    async def run(self) -> None:
        """Do all of it, now and every hour, for ever."""
        while True:
            try:
                await self.once()
            except StoreError as error:
                log.warning("upkeep put off", reason=str(error))
            except Exception:
                log.exception("upkeep failed")
            await asyncio.sleep(PERIOD_S)

    async def once(self) -> None:
        """Do all of it. Raises StoreTroubleError: the store is in trouble."""
        await asyncio.to_thread(self.sweep)
        await self._retention.tidy(in_use={session.session_id for session in self._sessions})
        days = self._settings.job_retention_days
        if forgotten := await self._jobs.forget_before(now_us() - round(days * DAY_US)):
            log.info("ended jobs forgotten", jobs=forgotten)

    def sweep(self, *, at_start: bool = False) -> None:
        """Remove what killed runs have left half done.

        Args:
            at_start: nothing of this worker is under way, so what lies in its own folders was left
                behind, however young it is.
        """
        settings = self._settings
        removed: list[Path] = []
        for folder in (settings.assets_path, settings.scenes_path):
            # What lies in our state folder is ours alone.
            own = folder.resolve().is_relative_to(settings.data_dir.resolve())
            unused_s = 0.0 if own and at_start else OTHERS_UNUSED_S
            removed += sweep_leftovers(folder, unused_s=unused_s, prefix=UPLOADS)
            removed += sweep_leftovers(folder, unused_s=OTHERS_UNUSED_S)
        unused_s = 0.0 if at_start else OTHERS_UNUSED_S
        removed += sweep_leftovers(settings.data_dir, unused_s=unused_s)
        removed += sweep_leftovers(settings.data_dir, unused_s=unused_s, prefix=RESTORING)
        removed += sweep_segments()
        if removed:
            names = [path.name for path in removed[:10]]
            log.warning("leftovers removed", count=len(removed), names=names)
