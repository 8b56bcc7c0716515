"""First use of Real2Sim from its wheels, in an empty home: evaluate a policy, and import a drive.

Deployment is tested in ``test_docker.py``.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.pages import BLOCK, REPOSITORY
from tests.waiting import wait_until

pytestmark = [pytest.mark.slow, pytest.mark.network]

INSTALL_S = 900


@dataclass
class Home:
    """An empty home with an environment in which the wheels are installed."""

    folder: Path
    bin: Path

    @property
    def environment(self) -> dict[str, str]:
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("REAL2SIM_", "PYTHON"))}
        return kept | {"HOME": str(self.folder), "PATH": f"{self.bin}:{os.environ['PATH']}"}

    def run(self, command: str) -> str:
        """Output of a shell command, which must succeed."""
        done = subprocess.run(
            ["bash", "-eo", "pipefail", "-c", command], cwd=self.folder, env=self.environment,
            capture_output=True, text=True, timeout=INSTALL_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def python(self, code: str) -> str:
        (self.folder / "script.py").write_text(code)
        return self.run("python script.py")


@pytest.fixture(scope="module")
def bin_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment with the wheels and their dependencies from pip."""
    root = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    sources = [REPOSITORY / "client", REPOSITORY]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", root, *sources], check=True)
    (wheel,) = root.glob("real2sim-*.whl")
    subprocess.run([sys.executable, "-m", "venv", root / "venv"], check=True)
    own = [root / "venv/bin/python", "-m", "pip", "--disable-pip-version-check", "-q"]
    pins = ["-c", REPOSITORY / "constraints.txt"]
    install = [*own, "install", "--no-compile", *pins, "--find-links", root, f"{wheel}[server]"]
    subprocess.run(install, check=True, timeout=INSTALL_S)
    return root / "venv" / "bin"


@pytest.fixture
def home(bin_folder: Path, tmp_path: Path) -> Home:
    return Home(tmp_path, bin_folder)


@pytest.fixture
def serve(home: Home) -> Iterator[Callable[[str], str]]:
    """Start a worker by a command. Returns its address."""
    started: list[subprocess.Popen[bytes]] = []

    def start(command: str) -> str:
        log = home.folder / "worker.log"
        with log.open("wb") as out:
            process = subprocess.Popen(
                [home.bin / "real2sim", *command.split()], cwd=home.folder, env=home.environment,
                stdout=out, stderr=subprocess.STDOUT,
            )  # fmt: skip
        started.append(process)

        def printed() -> str | None:
            found = re.search(r"http://127\.0\.0\.1:\d+(?=\D)", log.read_text())
            assert found or process.poll() is None, log.read_text()
            return found.group() if found else None

        return wait_until(printed, "the worker's address") or ""

    yield start
    for process in started:
        process.terminate()
        process.wait(60)


def block(page: str, words: str) -> str:
    (found,) = [t for _, t in BLOCK.findall((REPOSITORY / page).read_text("utf-8")) if words in t]
    return found


def test_a_camera_policy_is_compared_with_idm(home: Home, serve: Callable[[str], str]) -> None:
    url = serve("serve --demo --port 0 --data data")
    (home.folder / "mine.py").write_text(block("README.md", "class Mine"))
    home.run(
        f"real2sim drive --url {url} --planner mine:Mine --scene demo_street --steps 50 "
        "--json driven.json"
    )
    driven = json.loads((home.folder / "driven.json").read_text())
    assert driven["distance"] > 10
    home.run(
        f"real2sim evaluate-policy --url {url} --suite demo --policy mine:Mine --policy idm "
        "--seeds 5 --out out"
    )
    report = json.loads((home.folder / "out/report.json").read_text())
    whole = {g["policy"]: g for g in report["groups"] if g["case"] is None}
    assert set(whole) == {"mine:Mine", "idm"}
    assert {(g["episodes"], g["failed"]) for g in whole.values()} == {(15, 0)}
    assert (home.folder / "out/report.html").exists()


def test_a_log_from_arrays_is_checked_reconstructed_edited_and_driven(
    home: Home, serve: Callable[[str], str]
) -> None:
    arrays = block("docs/log_format.md", "# What was recorded")
    home.python(arrays + block("docs/log_format.md", "class Recording"))
    told = home.run("real2sim log-info my_drive --check")
    assert "no problems found" in told
    home.run("real2sim reconstruct my_drive --out scenes/mine")
    url = serve("serve --scenes scenes --port 0 --data data")
    edited = home.python(
        f"""
import real2sim
with real2sim.connect("{url}") as sim:
    sim.wait_ready()
    scenario = sim.scenarios.create("mine", "nearer")
    car = scenario.objects["car_0"]
    before = car.position[0]
    car.translate(-2.0, frame="object")
    assert abs(car.position[0] - before + 2.0) < 1e-6
    assert scenario.preview("front").shape == (120, 160, 3)
    print(scenario.scenario_id)
"""
    )
    home.run(
        f"real2sim drive --url {url} --planner idm --scenario {edited.strip()} --steps 3 "
        "--json driven.json"
    )
    assert json.loads((home.folder / "driven.json").read_text())["steps"] == 3
