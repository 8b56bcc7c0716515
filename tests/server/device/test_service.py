"""A complete worker on the pretended device against the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from real2sim_proto import decode
from real2sim_server.render import select_backend
from real2sim_server.render._cuda.serving import NvrtcBackend
from real2sim_server.render.backend import Backend
from real2sim_server.render.select import BACKENDS, BackendStatus, RegisteredBackend
from real2sim_server.service.app import create_app
from real2sim_server.settings import Settings

from ..render.kernel_twin import COMPILER, NEEDS_COMPILER
from . import pretended
from .pretended_launcher import PretendedLauncher

SENSORS = [
    {"camera": name, "modalities": ["rgb", "depth", "instance"], "codec": "raw"}
    for name in ("front", "left")
]
EDITS = [
    {"op": "duplicate", "object_id": "car_red", "new_id": "twin", "y": 6.0},
    {"op": "delete", "object_id": "post"},
    {"op": "translate", "object_id": "car_red", "x": 1.5},
]


@pytest.fixture
def start_worker(scenes_dir: Path, tmp_path: Path) -> Iterator[Callable[[str], TestClient]]:
    with ExitStack() as stack:

        def start(backend: str) -> TestClient:
            settings = Settings(
                data_dir=tmp_path / backend,
                scenes_dir=scenes_dir,
                import_root=tmp_path / "import",
                port=0,
                backend=backend,
                log_level="error",
                drain_seconds=0,
            )
            app = create_app(settings)
            return stack.enter_context(TestClient(app, base_url="http://127.0.0.1"))

        yield start


@pytest.fixture(params=["cuda", "nvrtc"])
def on_device(
    request: pytest.FixtureRequest,
    device_counts: pretended.Counts,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[str]:
    """Name of a backend on the pretended device."""
    if request.param == "nvrtc" and COMPILER is None:
        pytest.skip(NEEDS_COMPILER)
    backend: Backend = (
        NvrtcBackend(PretendedLauncher())
        if request.param == "nvrtc"
        else request.getfixturevalue("cuda_backend")
    )
    status = BackendStatus(request.param, True, "pretended")
    made = RegisteredBackend(lambda: status, lambda: backend)
    monkeypatch.setitem(BACKENDS, request.param, made)
    select_backend.cache_clear()
    yield request.param
    select_backend.cache_clear()


def pictures(client: TestClient) -> list[np.ndarray]:
    """Images of an edited scenario, driven for two steps."""
    made = client.post("/v1/scenarios", json={"scene": "tiny"})
    scenario = made.json()["scenario_id"]
    edited = client.post(f"/v1/scenarios/{scenario}/operations", json={"operations": EDITS})
    assert edited.status_code == 200, edited.text
    reset = {"reset": {"action": "control", "dt_us": 100_000}}
    session = client.post("/v1/sessions", params={"scenario": scenario}, json=reset).json()
    path = f"/v1/sessions/{session['session_id']}"
    bearer = {"Authorization": f"Bearer {session['token']}"}
    seen = []
    for _ in range(2):
        plan = {"kind": "control", "acceleration": 1.0, "steering": 0.0}
        stepped = client.post(f"{path}/step", json={"n": 2, "plan": plan}, headers=bearer)
        assert stepped.status_code == 200, stepped.text
        answer = client.post(f"{path}/render", json={"sensors": SENSORS}, headers=bearer)
        assert answer.status_code == 200, answer.text
        seen += [image(frame) for frame in decode(answer.content)["frames"]]
    scene = client.get("/v1/scenes/tiny/render", params={"camera": "front"})
    assert scene.status_code == 200, scene.text
    cut = {"scene": "tiny", "object_id": "car_red", "asset_id": "red"}
    assert client.post("/v1/assets", json=cut).status_code == 201
    assert client.get("/v1/assets/red/thumbnail").status_code == 200
    preview = client.get(f"/v1/scenarios/{scenario}/preview", params={"camera": "front"})
    assert preview.status_code == 200, preview.text
    return seen


def image(frame: dict[str, Any]) -> np.ndarray:
    data = frame["data"]
    if isinstance(data, np.ndarray):
        return data
    return np.frombuffer(data, dtype=frame.get("dtype", "uint8"))


@pytest.mark.slow
def test_a_worker_on_the_device_matches_the_reference(
    start_worker: Callable[[str], TestClient], on_device: str
) -> None:
    given, expected = (pictures(start_worker(name)) for name in (on_device, "reference"))
    assert len(given) == len(expected) == 12
    for here, there in zip(given, expected, strict=True):
        assert here.shape == there.shape
        assert here.dtype == there.dtype
        apart = np.abs(here.astype(np.float64) - there.astype(np.float64))
        limit = 1 if here.dtype == np.uint8 else 0.01
        # Depths are compared in float32, so the order of two near-equal ones may differ in a pixel.
        assert (apart > limit).mean() < 1e-3
