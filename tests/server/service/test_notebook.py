"""Runs the getting-started notebook, cell by cell, against a worker."""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from real2sim_server.scene.io import save_scene
from real2sim_server.service.serve import RunningWorker, running_worker
from real2sim_server.settings import Settings

from ..conftest import make_tiny_scene

NOTEBOOK = Path(__file__).parents[3] / "docs" / "ten_scripts.ipynb"
CELLS = [
    "".join(cell["source"])
    for cell in json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    if cell["cell_type"] == "code"
]


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[RunningWorker]:
    save_scene(make_tiny_scene("street"), tmp_path / "scenes" / "street.r2s")
    settings = Settings(
        data_dir=tmp_path / "data", scenes_dir=tmp_path / "scenes", port=0, backend="cpu"
    )
    # A machine without cached kernels takes a while to become ready.
    with running_worker(settings, timeout_s=280.0) as running:
        yield running


def shown(source: str, names: dict[str, Any]) -> Any:
    """Output of a notebook cell: the value of its last line."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, NOTEBOOK.name, "exec"), names)
    if last is None:
        return None
    return eval(compile(ast.Expression(last.value), NOTEBOOK.name, "eval"), names)


@pytest.mark.network
@pytest.mark.slow
def test_every_cell_runs(
    worker: RunningWorker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("REAL2SIM_URL", worker.url)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    values = [shown(source, names) for source in CELLS]
    images = [value for value in values if hasattr(value, "_repr_jpeg_")]
    assert len(images) == 4
    assert all(image._repr_jpeg_().startswith(b"\xff\xd8") for image in images)
    assert (tmp_path / "film.webm").stat().st_size > 1000
    # The notebook has removed what it created on the worker.
    with names["real2sim"].connect() as sim:
        assert not list(sim.scenarios)
