"""Drives as test_determinism does, in a process of its own; prints the hashes."""

from __future__ import annotations

import importlib.util
import json
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from real2sim_server.service.logging_setup import configure_logging
from real2sim_server.service.serve import running_worker
from real2sim_server.settings import Settings


def beside(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(scenes: Path) -> None:
    configure_logging(level="error")
    shared, determinism = beside("conftest"), beside("test_determinism")
    with tempfile.TemporaryDirectory() as folder:
        options: dict[str, Any] = {"backend": "cpu", "threads": 1, "log_level": "error"}
        settings = Settings(data_dir=folder, scenes_dir=scenes, port=0, **options)
        with running_worker(settings) as running:
            site = shared.Site(running, stop=lambda: None)
            with shared.Planner(site.create()) as planner:
                planner.hello()
                print(json.dumps(determinism.fingerprint(planner)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
