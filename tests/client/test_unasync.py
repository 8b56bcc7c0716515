"""The sync client is generated from the async one."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

CLIENT = Path(__file__).resolve().parents[2] / "client"
FOLDER = CLIENT / "real2sim" / "_sync"
MADE = runpy.run_path(str(CLIENT / "hatch_build.py"))["sync_files"]()


def test_the_sync_client_is_up_to_date() -> None:
    there = {path.name: path.read_text("utf-8") for path in FOLDER.glob("*.py")}
    assert {name: there.get(name) for name in MADE} == MADE, "run `make sync`"


@pytest.mark.parametrize("name", MADE)
def test_the_sync_client_contains_no_async_code(name: str) -> None:
    code = re.sub(r"from collections.abc import .*", "", MADE[name].split("\n", 1)[1])
    assert re.findall(r"\b(?:await|async|asyncio|Async\w+|Awaitable)\b", code) == []
