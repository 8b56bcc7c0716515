"""Build the SDK: make the sync client from the async one, and put the contract into the wheel.

``python client/hatch_build.py`` only writes the sync client, ``real2sim/_sync``, which is not in
version control. An editable install writes it too. What cannot be translated word by word is in
``concurrency.py``, of which each side has its own.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ImportError:  # Run as a program.
    BuildHookInterface = object

ROOT = Path(__file__).resolve().parent
ASYNC, SYNC = ROOT / "real2sim" / "_async", ROOT / "real2sim" / "_sync"
BY_HAND = {"__init__.py", "concurrency.py"}
HEADER = "# Made from _async/{name} by client/hatch_build.py; edit that file instead.\n"

SUBSTITUTIONS = (
    (r"\basync (def|with|for)\b", r"\1"),
    (r"\bawait\s+", ""),
    (r"\bAwaitable\[([^\[\]]+)\]", r"\1"),
    (r"\bAsync([A-Z]\w*)", r"\1"),
    (r"\b__aenter__\b", "__enter__"),
    (r"\b__aexit__\b", "__exit__"),
    (r"\b__aiter__\b", "__iter__"),
    (r"\baclose\b", "close"),
    (r"\benter_async_context\b", "enter_context"),
    (r"\bconnect_async\b", "connect"),
)


class CustomBuildHook(BuildHookInterface):  # type: ignore[misc]
    """Makes ``_sync`` before a build, and adds ``real2sim_proto`` to wheels and sdists."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Prepare a build; ``version`` is "standard" or "editable"."""
        write_sync()
        if version == "standard":
            # Next to this folder in the repository, inside it in an sdist.
            places = (ROOT.parent / "proto" / "real2sim_proto", ROOT / "real2sim_proto")
            contract = next(place for place in places if place.is_dir())
            build_data["force_include"][str(contract)] = "real2sim_proto"


def write_sync() -> None:
    """Write the sync client. A file that is already right is left alone."""
    wanted = sync_files()
    for path in SYNC.glob("*.py"):
        if path.name not in wanted.keys() | BY_HAND:
            path.unlink()
    for name, text in wanted.items():
        path = SYNC / name
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, encoding="utf-8")


def sync_files() -> dict[str, str]:
    """The text of each file of the sync client that is made, by its name."""
    sources = [path for path in ASYNC.glob("*.py") if path.name not in BY_HAND]
    return {path.name: translate(path.read_text("utf-8"), path.name) for path in sources}


def translate(text: str, name: str) -> str:
    """The sync form of an async module. Code, docstrings and examples are translated alike."""
    for pattern, replacement in SUBSTITUTIONS:
        text = re.sub(pattern, replacement, text)
    return HEADER.format(name=name) + text


if __name__ == "__main__":
    write_sync()
