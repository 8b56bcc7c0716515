"""``python -m real2sim_server.service.write_openapi FILE``: the OpenAPI document as a file."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from ..settings import Settings
from .app import create_app
from .http.openapi import document, text_of


def write(path: Path) -> None:
    """Write the document of a worker with default settings."""
    with tempfile.TemporaryDirectory() as folder:
        path.write_text(text_of(document(create_app(Settings(data_dir=Path(folder))))))


if __name__ == "__main__":
    write(Path(sys.argv[1]))
