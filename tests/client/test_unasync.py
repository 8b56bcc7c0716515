"""The sync client is made from the async one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_sync_client_is_what_the_script_makes() -> None:
    command = [sys.executable, REPOSITORY / "scripts" / "unasync.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


MADE = sorted(
    path
    for path in (REPOSITORY / "client/real2sim/_sync").glob("*.py")
    if path.name not in {"__init__.py", "concurrency.py"}
)


@pytest.mark.parametrize("path", MADE, ids=lambda path: path.stem)
def test_nothing_async_is_left_in_the_sync_client(path: Path) -> None:
    code = path.read_text("utf-8").split("\n", 1)[1]
    assert re.findall(r"\b(?:await|async|asyncio|Async\w+|Awaitable)\b", code) == []
