"""Make the sync client, ``client/real2sim/_sync``, from the async one, ``_async``.

``python scripts/unasync.py`` writes the files; with ``--check`` it writes nothing and exits with 1
where one of them is not what it would write. Code, docstrings and examples are translated alike;
what cannot be translated word by word lives in ``concurrency.py``, of which each side has its own.
"""

from __future__ import annotations

import argparse
import difflib
import re
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "client" / "real2sim"
ASYNC, SYNC = PACKAGE / "_async", PACKAGE / "_sync"
BY_HAND = {"__init__.py", "concurrency.py"}
HEADER = "# Made from _async/{name} by scripts/unasync.py; edit that file, then run the script.\n"

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


def main() -> int:
    """Write or check every file; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing, say what differs")
    check = parser.parse_args().check
    differing = [name for name in names() if not settle(name, check=check)]
    if differing and check:
        print(f"run python scripts/unasync.py: {', '.join(differing)} of _sync would change")
    return 1 if differing and check else 0


def names() -> list[str]:
    """Names of the files that are translated, and of those in ``_sync`` that have no source."""
    found = {path.name for folder in (ASYNC, SYNC) for path in folder.glob("*.py")}
    return sorted(found - BY_HAND)


def settle(name: str, *, check: bool) -> bool:
    """Whether the file was what it has to be; unless ``check``, it is so afterwards."""
    source, target = ASYNC / name, SYNC / name
    wanted = translated(source.read_text("utf-8"), name) if source.exists() else ""
    there = target.read_text("utf-8") if target.exists() else ""
    if wanted == there:
        return True
    if check:
        lines = (text.splitlines(keepends=True) for text in (there, wanted))
        sys.stdout.writelines(difflib.unified_diff(*lines, f"_sync/{name}", "what it has to be"))
    elif wanted:
        target.write_text(wanted, encoding="utf-8")
    else:
        target.unlink()
    return False


def translated(text: str, name: str) -> str:
    """The sync form of an async module, formatted as the repository is."""
    for pattern, replacement in SUBSTITUTIONS:
        text = re.sub(pattern, replacement, text)
    text = HEADER.format(name=name) + text
    # What only the async form imports falls out; lines that have become shorter are joined.
    fixed = ruff(text, name, "check", "--fix", "--select", "F401,I", "--quiet")
    return ruff(fixed, name, "format", "--quiet")


def ruff(text: str, name: str, *command: str) -> str:
    """The text as ruff leaves it."""
    line = [sys.executable, "-m", "ruff", *command, "--stdin-filename", str(SYNC / name), "-"]
    done = subprocess.run(line, input=text, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"ruff cannot read the sync form of {name}:\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
