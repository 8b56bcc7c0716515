"""How a client finds its worker, and errors if there is none."""

from __future__ import annotations

import asyncio
import subprocess
import sys

import httpx2
import pytest

import real2sim

SCENES = {"scenes": [{"scene": "street", "state": "resident"}]}


def request_of(**options: object) -> httpx2.Request:
    """The request sent by a client with these options."""
    requests = []

    def answer(request: httpx2.Request) -> httpx2.Response:
        requests.append(request)
        return httpx2.Response(200, json=SCENES)

    with real2sim.connect(transport=httpx2.MockTransport(answer), **options) as client:
        client.scenes.list()
    return requests[0]


@pytest.fixture(autouse=True)
def no_worker_in_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("REAL2SIM_URL", raising=False)
    monkeypatch.delenv("REAL2SIM_TOKEN", raising=False)


def test_the_default_is_loopback_without_a_token() -> None:
    request = request_of()
    assert str(request.url).startswith("http://127.0.0.1:8600/")
    assert "authorization" not in request.headers


def test_the_environment_overrides_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REAL2SIM_URL", "http://worker:9000")
    monkeypatch.setenv("REAL2SIM_TOKEN", "from-the-environment")
    request = request_of()
    assert str(request.url).startswith("http://worker:9000/")
    assert request.headers["authorization"] == "Bearer from-the-environment"


def test_arguments_override_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REAL2SIM_URL", "http://worker:9000")
    monkeypatch.setenv("REAL2SIM_TOKEN", "from-the-environment")
    request = request_of(url="http://other:1", token="given")
    assert str(request.url).startswith("http://other:1/")
    assert request.headers["authorization"] == "Bearer given"


def test_an_empty_token_disables_the_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REAL2SIM_TOKEN", "from-the-environment")
    assert "authorization" not in request_of(token="").headers


def test_empty_variables_count_as_unset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REAL2SIM_URL", "")
    monkeypatch.setenv("REAL2SIM_TOKEN", "")
    request = request_of()
    assert str(request.url).startswith("http://127.0.0.1:8600/")
    assert "authorization" not in request.headers


def test_an_invalid_url_from_the_environment_names_the_variable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("REAL2SIM_URL", "worker:9000")
    with pytest.raises(ValueError, match=r"'worker:9000' is not an address .*from REAL2SIM_URL"):
        real2sim.connect()


def test_the_async_client_reads_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REAL2SIM_URL", "http://worker:9000")
    assert repr(real2sim.connect_async()) == "AsyncClient('http://worker:9000', token=None)"


def test_a_script_without_a_worker_ends_with_one_short_error() -> None:
    script = "import real2sim\nreal2sim.connect('http://127.0.0.1:9', retries=0).scenes.list()\n"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.stderr.count("Traceback") == 1
    *frames, error, hint = done.stderr.splitlines()
    assert len(frames) <= 10
    assert error.startswith(
        "real2sim.errors.UnreachableError: no worker answers at http://127.0.0.1:9: "
    )
    assert hint == "hint: start a worker with `real2sim serve`, or check the address"


def test_the_async_client_hides_the_underlying_library_error() -> None:
    async def ask() -> None:
        async with real2sim.connect_async("http://127.0.0.1:9", retries=0) as client:
            await client.scenes.list()

    with pytest.raises(real2sim.UnreachableError) as caught:
        asyncio.run(ask())
    assert caught.value.__suppress_context__
    assert caught.value.__cause__ is None
