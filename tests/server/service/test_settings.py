from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from real2sim_server.settings import Settings


def test_environment_variables_set_missing_values(monkeypatch):
    monkeypatch.setenv("REAL2SIM_PORT", "9000")
    monkeypatch.setenv("REAL2SIM_TOKEN", "correct horse")
    settings = Settings(worker_id="w3")
    assert (settings.port, settings.worker_id) == (9000, "w3")
    assert settings.token.get_secret_value() == "correct horse"


def test_every_setting_loses_the_white_space_around_it(monkeypatch, tmp_path):
    for name, value in {"HOST": "0.0.0.0", "LOG_LEVEL": "debug", "DEMO": "true"}.items():
        monkeypatch.setenv(f"REAL2SIM_{name}", value + "\r")
    (tmp_path / "token").write_bytes("\ufeffcorrect horse\r\n".encode())
    found = Settings(store_url=" sqlite:///x\n", token_file=f"{tmp_path / 'token'}\r")
    assert (found.host, found.log_level, found.demo) == ("0.0.0.0", "debug", True)
    assert found.store_url == "sqlite:///x"
    assert found.token.get_secret_value() == "correct horse"


def test_a_setting_with_a_control_character_is_refused_by_its_name():
    said = r"setting store_url: character 9 is U\+000A"
    with pytest.raises(ValidationError, match=said) as error:
        Settings(store_url="sqlite:/\n/hunter2")
    assert "hunter2" not in str(error.value)


@pytest.mark.parametrize("end", ["\r", "\r\n", " \n"])
def test_the_line_ending_of_a_token_is_stripped(monkeypatch, tmp_path, end):
    monkeypatch.setenv("REAL2SIM_TOKEN", "correct horse" + end)
    assert Settings().token.get_secret_value() == "correct horse"
    monkeypatch.delenv("REAL2SIM_TOKEN")
    (tmp_path / "token").write_bytes(f"correct horse{end}".encode())
    found = Settings(token_file=tmp_path / "token").token
    assert found.get_secret_value() == "correct horse"


def test_a_token_that_is_not_a_valid_header_is_refused_without_revealing_it():
    with pytest.raises(
        ValidationError, match=r"token\n.*character 8 of the token is U\+000D"
    ) as error:
        Settings(token="correct\rhorse")
    assert "horse" not in str(error.value)


def test_the_repr_does_not_reveal_the_token():
    assert "correct" not in repr(Settings(token="correct horse"))


def test_folders_and_store_are_below_the_data_folder_by_default():
    settings = Settings(data_dir=Path("/x"))
    assert settings.scenes_path == Path("/x/scenes")
    assert settings.import_path == Path("/x/import")
    assert settings.database_url == "sqlite:////x/real2sim.db"


def test_the_default_host_is_loopback():
    assert Settings().host == "127.0.0.1"


@pytest.mark.parametrize(
    "wrong",
    [{"worker_id": "worker 1"}, {"port": 70000}, {"token": "short"}, {"backend": "vulkan"}],
)
def test_invalid_values_are_refused(wrong):
    with pytest.raises(ValidationError):
        Settings(**wrong)
