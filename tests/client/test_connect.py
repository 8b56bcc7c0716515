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


@pytest.mark.parametrize("text", ["http://worker:1/ ", "http://worker:1\r", " http://worker:1//\n"])
def test_white_space_and_slashes_around_the_url_are_removed(
    monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    assert str(request_of(url=text).url) == "http://worker:1/v1/scenes"
    monkeypatch.setenv("REAL2SIM_URL", text)
    assert str(request_of().url) == "http://worker:1/v1/scenes"


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("http://anna:hunter2@worker", "holds credentials"),
        ("ftp://anna:hunter2@worker", "holds credentials"),
        ("anna:hunter2@worker:80", "holds credentials"),
        ("http://worker/?token=hunter2", "part after"),
        ("http://worker/#hunter2", "part after"),
        ("http://wor\nker/hunter2", "character 11 of the url is U\\+000A"),
        ("http://wor ker", "character 11 of the url is U\\+0020"),
        ("http://worker:99999", "is not an address"),
        ("http://worker:port", "is not an address"),
        ("http://[::1", "is not an address"),
        ("localhost:8600", "is not an address"),
    ],
)
def test_a_url_that_is_no_address_is_refused_without_its_secrets(url: str, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        real2sim.connect(url)
    assert "hunter2" not in str(caught.value)


def test_a_token_loses_the_carriage_return_of_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REAL2SIM_TOKEN", "secret\r")
    assert request_of().headers["authorization"] == "Bearer secret"


@pytest.mark.parametrize("token", ["hun\nter2", "hun\rter2", "hünter2", "hunter2" * 100])
def test_an_invalid_token_is_refused_without_revealing_it(
    monkeypatch: pytest.MonkeyPatch, token: str
) -> None:
    with pytest.raises(ValueError, match="the token") as given:
        real2sim.connect(token=token)
    monkeypatch.setenv("REAL2SIM_TOKEN", token)
    with pytest.raises(ValueError, match=r"the token .*from REAL2SIM_TOKEN") as found:
        real2sim.connect()
    with pytest.raises(ValueError, match="the token") as joined:
        real2sim.connect(token="").join("w0-1", token=token)
    for caught in (given, found, joined):
        assert "ter2" not in str(caught.value)


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
