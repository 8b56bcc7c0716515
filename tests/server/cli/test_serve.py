"""How ``real2sim serve`` begins and ends, seen from outside."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from real2sim_server.settings import Settings, unknown_variables

LOST = (
    "import sys\n"
    "from real2sim_server.service.rendering import renderer\n"
    "def lose(*_): raise RuntimeError('CUDA error: an illegal memory access was encountered')\n"
    "renderer.warm_up = lose\n"
)
WITHOUT_CUDA = "import torch; torch.cuda.is_available = lambda: False\n"
MAIN = "import sys; from real2sim.cli import main; sys.argv[0] = 'real2sim'; main()"


def serve(*arguments: str, before: str = "", **variables: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("REAL2SIM_")}
    return subprocess.run(
        [sys.executable, "-c", before + MAIN, "serve", *arguments],
        env=kept | {f"REAL2SIM_{name}": value for name, value in variables.items()},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.fixture
def folders(tmp_path) -> dict[str, str]:
    (tmp_path / "scenes").mkdir()
    return {
        "PORT": "0",
        "BACKEND": "cpu",
        "DATA_DIR": str(tmp_path / "data"),
        "SCENES_DIR": str(tmp_path / "scenes"),
    }


def test_a_lost_device_ends_the_command_with_an_error_code(folders):
    done = serve(before=LOST, **folders)
    assert done.returncode == 1, done.stderr[-2000:]
    assert "device lost" in done.stderr


def test_a_worker_that_is_to_draw_on_cuda_and_cannot_is_refused_in_a_sentence(folders):
    done = serve(**(folders | {"BACKEND": "cuda"}), before=WITHOUT_CUDA)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "backend 'cuda' is not usable" in done.stderr
    assert "pip install" in done.stderr or "driver" in done.stderr


def test_a_store_that_cannot_be_opened_is_told_in_a_sentence(folders):
    url = "postgresql+pg8000://nobody:hunter2@127.0.0.1:9/none"
    done = serve(STORE_URL=url, LOG_FORMAT="json", **folders)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "hunter2" not in done.stderr
    *_, last = done.stderr.strip().splitlines()
    assert last.startswith("error: cannot open the store")
    assert len(done.stderr) < 1500


def test_a_short_token_is_refused_without_showing_it(folders):
    done = serve(TOKEN="hunter2", **folders)
    assert done.returncode == 1
    assert "setting token" in done.stderr
    assert "hunter2" not in done.stderr


def test_a_misspelt_variable_is_refused_with_the_setting_that_is_meant(folders):
    done = serve(TOKEN_FLIE="x", **folders)
    assert done.returncode == 1
    assert "REAL2SIM_TOKEN_FLIE is no setting; do you mean REAL2SIM_TOKEN_FILE?" in done.stderr


def test_other_unknown_variables_are_not_in_the_way():
    # Kubernetes sets such variables for a service of this name.
    names = ["REAL2SIM_SERVICE_PORT_HTTP", "REAL2SIM_PORT", "REAL2SIM_URL", "HOME"]
    assert unknown_variables(names) == {"REAL2SIM_SERVICE_PORT_HTTP": None}


def test_a_token_is_read_from_a_file(tmp_path, monkeypatch):
    file = tmp_path / "token"
    file.write_text("correct horse\n")
    monkeypatch.setenv("REAL2SIM_TOKEN_FILE", str(file))
    assert Settings().token.get_secret_value() == "correct horse"
    with pytest.raises(ValueError, match="both given"):
        Settings(token="battery staple")


def test_a_token_file_that_is_not_there_is_told(folders, tmp_path):
    done = serve("--token-file", str(tmp_path / "none"), **folders)
    assert done.returncode == 1
    assert "the token cannot be read" in done.stderr


def test_a_token_as_an_argument_is_warned_of(folders):
    done = serve("--token", "correct horse", before=LOST, **folders)
    assert "--token shows in the process list" in done.stderr
