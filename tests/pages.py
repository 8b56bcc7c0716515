"""Code blocks of README and docs, for tests that run them in page order."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)
LIMIT_S = 1800
PACKAGES = ("proto", "client", "server")


@dataclass
class Page:
    """The blocks of a page, in order. Python blocks share names, shell blocks share variables."""

    path: Path
    folder: Path
    names: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._blocks = BLOCK.findall(self.path.read_text("utf-8"))
        (self.folder / "state").touch()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            assert self._blocks == [], "blocks that no test runs"

    def block(self, words: str) -> str:
        """The next block, which must contain these words."""
        _, text = self._blocks.pop(0)
        assert words in text
        return text

    def json(self, words: str) -> Any:
        return json.loads(self.block(words))

    def python(self, words: str, **instead: str) -> dict[str, Any]:
        """Run the next block. Returns the names defined so far."""
        exec(replaced(self.block(words), instead), self.names)
        return self.names

    def shell(self, words: str, instead: dict[str, str] | None = None) -> str:
        """Run the next block. Returns its output. Stops at the first failing command."""
        text = replaced(self.block(words), instead or {})
        script = f"set -aeo pipefail\n. ./state\n{text}\n{{ export -p; declare -f; }} > state"
        environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": os.pathsep.join(str(REPOSITORY / n) for n in PACKAGES),
        }
        done = subprocess.run(
            ["bash", "-c", script], cwd=self.folder, env=environment, capture_output=True,
            text=True, timeout=LIMIT_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"
        return done.stdout


def replaced(text: str, instead: dict[str, str]) -> str:
    """Replace addresses and sizes by those of the test. Each of them must occur."""
    for old, new in instead.items():
        assert old in text
        text = text.replace(old, new)
    return text
