"""A planner of the SDK in a process of its own, which drives over the socket like any client."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from dataclasses import dataclass

from real2sim_proto.jobs import DriveRequest

from ..sessions.session import Session

CLOSE_S = 3.0
MAX_ERROR_BYTES = 16_384
EPISODE_STEPS = 100_000
"""More than any recording has: it ends with its episode."""

OF_THE_PLANNER = {
    *("sensors", "lidars", "radars", "action", "privileged"),
    *("seed", "dt_us", "warmup_us"),
}
"""Of a reset: what a planner says itself, and what the command has options of its own for."""


@dataclass(eq=False)
class PlannerProcess:
    """`real2sim drive --session`, started by :meth:`start`."""

    _process: asyncio.subprocess.Process
    _errors: asyncio.Task[bytes]

    @classmethod
    async def start(
        cls, request: DriveRequest, session: Session, *, url: str, token: str
    ) -> PlannerProcess:
        """Start it.

        Args:
            request: which planner, and for how long.
            session: that it drives, reset as it was made.
            url: of the worker.
            token: of the session; handed over in the environment, which other users cannot read.
        """
        process = await asyncio.create_subprocess_exec(
            *_command(request, session, url),
            env=os.environ | {"REAL2SIM_SESSION_TOKEN": token},
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        assert process.stderr is not None
        return cls(process, asyncio.create_task(_last_of(process.stderr)))

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.returncode is None

    async def error(self) -> str | None:
        """What it said last, where it failed; after its end."""
        if await self._process.wait() == 0:
            return None
        said = (await self._errors).decode("utf-8", "replace").split("\n")
        lines = [line.strip() for line in said if line.strip()]
        return lines[-1] if lines else f"the planner ended with {self._process.returncode}"

    async def close(self) -> None:
        """End it, whatever it does."""
        for end in (self._process.terminate, self._process.kill):
            if not self.running:
                break
            with contextlib.suppress(ProcessLookupError):
                end()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_S):
                    await self._process.wait()
        await self._errors


def _command(request: DriveRequest, session: Session, url: str) -> list[str]:
    spec = session.spec
    reset = spec.model_dump(mode="json", exclude_unset=True, exclude=OF_THE_PLANNER)
    options = {
        "--session": session.session_id,
        "--planner": str(request.planner),
        "--steps": str(request.steps or EPISODE_STEPS),
        "--seed": str(spec.seed),
        "--dt-us": str(spec.dt_us),
        "--warmup-us": str(spec.warmup_us),
        "--reset": json.dumps(reset),
        "--url": url,
    }
    given = [text for option in options.items() for text in option]
    return [sys.executable, "-m", "real2sim", "drive", *given]


async def _last_of(stream: asyncio.StreamReader) -> bytes:
    """The end of a stream, once it has ended."""
    kept = b""
    while data := await stream.read(65_536):
        kept = (kept + data)[-MAX_ERROR_BYTES:]
    return kept
