"""What the container files promise, as far as it can be read off them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

DOCKER = Path(__file__).parents[1] / "docker"
IMAGES = ["Dockerfile.cpu", "Dockerfile.gpu"]


@pytest.fixture(scope="module")
def worker():
    return yaml.safe_load((DOCKER / "compose.yml").read_text())["services"]["worker0"]


def test_the_folder_of_scenes_is_that_beside_the_readme_and_scenes_can_be_imported_into_it(worker):
    (scenes,) = (v for v in worker["volumes"] if v.split(":")[-1] == "/scenes")
    default = re.match(r"\$\{REAL2SIM_SCENES:-(.*?)\}", scenes)
    assert default is not None
    assert (DOCKER / default[1]).resolve().parent == DOCKER.parent


def test_a_worker_writes_nowhere_but_to_its_volumes(worker):
    assert worker["read_only"] is True
    assert [place.split(":")[0] for place in worker["tmpfs"]] == ["/tmp"]


def test_a_worker_has_no_capabilities_and_gets_none(worker):
    assert worker["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in worker["security_opt"]


def test_what_a_worker_takes_is_limited(worker):
    assert worker["mem_limit"]
    assert worker["pids_limit"] <= 1024
    assert set(worker["logging"]["options"]) == {"max-size", "max-file"}


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_runs_as_a_user_whose_number_shows_that_it_is_not_root(name):
    lines = (DOCKER / name).read_text().splitlines()
    users = [line.split()[1] for line in lines if line.startswith("USER ")]
    assert users == ["10001:10001"]
    assert "useradd --uid 10001 --gid 10001" in (DOCKER / "entry-layer.sh").read_text()


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_is_built_only_if_no_kernel_is_left_to_compile(name):
    assert "real2sim doctor --warm && real2sim doctor --warmed" in (DOCKER / name).read_text()


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_can_share_a_database_server(name):
    assert re.search(r"'\.\[server,.*postgres.*\]'", (DOCKER / name).read_text())
