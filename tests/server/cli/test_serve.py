"""Start and exit of ``real2sim serve``, seen from outside."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from real2sim_server.settings import Settings, unknown_variables

from ..worker_processes import Finished, run_real2sim

LOST = (
    "import sys\n"
    "from real2sim_server.service import renderer\n"
    "def lose(*_): raise RuntimeError('CUDA error: an illegal memory access was encountered')\n"
    "renderer.warm_up = lose\n"
)
WITHOUT_CUDA = "import torch; torch.cuda.is_available = lambda: False\n"


@pytest.fixture
def serve(tmp_path) -> Callable[..., Finished]:
    """Run ``real2sim serve`` until it exits."""

    def run(*arguments: str, before: str = "", **variables: str) -> Finished:
        return run_real2sim(
            ["serve", *arguments],
            log_file=tmp_path / "log",
            environment={f"REAL2SIM_{name}": value for name, value in variables.items()},
            before=before,
        )

    return run


@pytest.fixture
def folders(tmp_path) -> dict[str, str]:
    (tmp_path / "scenes").mkdir()
    return {
        "PORT": "0",
        "BACKEND": "cpu",
        "DATA_DIR": str(tmp_path / "data"),
        "SCENES_DIR": str(tmp_path / "scenes"),
    }


@pytest.mark.slow
def test_a_lost_device_exits_with_an_error(serve, folders):
    done = serve(before=LOST, **folders)
    assert done.exit_code == 1, done.printed
    assert "device lost" in done.printed


def test_an_unusable_cuda_backend_is_refused_without_a_traceback(serve, folders):
    done = serve(**(folders | {"BACKEND": "cuda"}), before=WITHOUT_CUDA)
    assert done.exit_code == 1
    assert "Traceback" not in done.printed
    assert "backend 'cuda' is not usable" in done.printed
    assert "pip install" in done.printed or "driver" in done.printed


@pytest.mark.slow
def test_an_unreachable_store_is_reported_without_a_traceback(serve, folders):
    url = "postgresql+pg8000://nobody:hunter2@127.0.0.1:9/none"
    done = serve(STORE_URL=url, LOG_FORMAT="json", **folders)
    assert done.exit_code == 1
    assert "Traceback" not in done.printed
    assert "hunter2" not in done.printed
    *_, last = done.printed.strip().splitlines()
    assert last.startswith("error: cannot open the store")
    assert len(done.printed) < 1500


def test_a_short_token_is_refused_without_revealing_it(serve, folders):
    done = serve(TOKEN="hunter2", **folders)
    assert done.exit_code == 1
    assert "setting token: it is shorter than 8 characters" in done.printed
    assert "hunter2" not in done.printed


def test_a_misspelt_variable_is_refused_with_a_suggestion(serve, folders):
    done = serve(TOKEN_FLIE="x", **folders)
    assert done.exit_code == 1
    assert "REAL2SIM_TOKEN_FLIE is not a setting; do you mean REAL2SIM_TOKEN_FILE?" in done.printed


def test_unknown_variables_without_a_similar_setting_are_tolerated():
    # Kubernetes sets such variables for a service with this name.
    names = ["REAL2SIM_SERVICE_PORT_HTTP", "REAL2SIM_PORT", "REAL2SIM_URL", "HOME"]
    assert unknown_variables(names) == {"REAL2SIM_SERVICE_PORT_HTTP": None}


def test_a_token_is_read_from_a_file(tmp_path, monkeypatch):
    file = tmp_path / "token"
    file.write_text("correct horse\n")
    monkeypatch.setenv("REAL2SIM_TOKEN_FILE", str(file))
    assert Settings().token.get_secret_value() == "correct horse"
    with pytest.raises(ValueError, match="both given"):
        Settings(token="battery staple")


def test_a_missing_token_file_is_reported(serve, folders, tmp_path):
    done = serve("--token-file", str(tmp_path / "none"), **folders)
    assert done.exit_code == 1
    assert "the token cannot be read" in done.printed


def test_a_token_on_the_command_line_gives_a_warning(serve, folders):
    done = serve("--token", "correct horse", before=LOST, **folders)
    assert "--token shows in the process list" in done.printed
