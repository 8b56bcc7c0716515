"""A command of this program in a process of its own, as the work of a job."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Self

CLOSE_S = 3.0
NICENESS = 10
"""Of a command that gives way."""

MAX_ERROR_BYTES = 16_384
MAX_LINE_BYTES = 65_536


class CommandProcess:
    """``real2sim ...``, started by :meth:`run`.

    Attributes:
        told: the newest line of JSON on its standard output, where that is read; None before one.
    """

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        assert process.stderr is not None
        self.told: Mapping[str, Any] | None = None
        self._process = process
        self._errors = asyncio.create_task(_last_of(process.stderr))
        self._listening = asyncio.create_task(self._listen())

    @classmethod
    async def run(
        cls,
        arguments: Sequence[str],
        *,
        environment: Mapping[str, str] | None = None,
        follow: bool = False,
    ) -> Self:
        """Start it.

        Args:
            arguments: behind ``real2sim``.
            environment: variables that it has beside those of this process.
            follow: whether its standard output is read, and its standard input ends with this
                process, as ``--follow`` wants it.
        """
        pipe, nothing = asyncio.subprocess.PIPE, asyncio.subprocess.DEVNULL
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "real2sim", *arguments),
            env=os.environ | dict(environment or {}),
            stdin=pipe if follow else nothing,
            stdout=pipe if follow else nothing,
            stderr=pipe,
            limit=MAX_LINE_BYTES,
        )
        return cls(process)

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._process.returncode is None

    def yield_to_urgent(self) -> None:
        """Let it have what processor time others leave."""
        # It has ended, or the system has no such thing.
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICENESS)

    async def error(self) -> str | None:
        """What it said last, where it failed; after its end."""
        if await self._process.wait() == 0:
            return None
        said = (await self._errors).decode("utf-8", "replace").split("\n")
        lines = [line.strip() for line in said if line.strip()]
        return lines[-1] if lines else f"the process ended with {self._process.returncode}"

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
        await self._listening

    async def _listen(self) -> None:
        if self._process.stdout is None:
            return
        # A line that is too long, or none of JSON, is not of those that are followed.
        while True:
            try:
                line = await self._process.stdout.readline()
                if not line:
                    return
                told = json.loads(line)
            except ValueError:
                continue
            if isinstance(told, dict):
                self.told = told


async def _last_of(stream: asyncio.StreamReader) -> bytes:
    """The end of a stream, once it has ended."""
    kept = b""
    while data := await stream.read(65_536):
        kept = (kept + data)[-MAX_ERROR_BYTES:]
    return kept
