from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from real2sim_server.settings import Settings


def test_the_environment_sets_what_is_not_given(monkeypatch):
    monkeypatch.setenv("REAL2SIM_PORT", "9000")
    monkeypatch.setenv("REAL2SIM_TOKEN", "correct horse")
    settings = Settings(worker_id="w3")
    assert (settings.port, settings.worker_id) == (9000, "w3")
    assert settings.token.get_secret_value() == "correct horse"


@pytest.mark.parametrize("end", ["\r", "\r\n", " \n"])
def test_a_token_loses_the_end_of_its_line(monkeypatch, tmp_path, end):
    monkeypatch.setenv("REAL2SIM_TOKEN", "correct horse" + end)
    assert Settings().token.get_secret_value() == "correct horse"
    monkeypatch.delenv("REAL2SIM_TOKEN")
    (tmp_path / "token").write_bytes(f"correct horse{end}".encode())
    found = Settings(token_file=tmp_path / "token").token
    assert found.get_secret_value() == "correct horse"


def test_a_token_that_no_header_can_hold_is_refused_without_showing_it():
    with pytest.raises(
        ValidationError, match=r"token\n.*character 8 of the token is U\+000D"
    ) as error:
        Settings(token="correct\rhorse")
    assert "horse" not in str(error.value)


def test_the_token_is_not_shown():
    assert "correct" not in repr(Settings(token="correct horse"))


def test_folders_and_store_lie_below_the_data_folder_by_default():
    settings = Settings(data_dir=Path("/x"))
    assert settings.scenes_path == Path("/x/scenes")
    assert settings.import_path == Path("/x/import")
    assert settings.database_url == "sqlite:////x/real2sim.db"


def test_listening_beyond_this_machine_is_not_the_default():
    assert Settings().host == "127.0.0.1"


@pytest.mark.parametrize(
    "wrong",
    [{"worker_id": "worker 1"}, {"port": 70000}, {"token": "short"}, {"backend": "vulkan"}],
)
def test_values_that_cannot_be_are_refused(wrong):
    with pytest.raises(ValidationError):
        Settings(**wrong)
