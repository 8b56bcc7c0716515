"""Guarantees that can be read from the container files."""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import shutil
import subprocess
import tomllib
import urllib.request
from importlib.metadata import requires
from pathlib import Path

import pytest
import yaml

from real2sim import UnauthorizedError, connect

from .server.worker_processes import printed_url, start_real2sim

DOCKER = Path(__file__).parents[1] / "docker"
IMAGES = ["Dockerfile.cpu", "Dockerfile.gpu"]


@pytest.fixture(scope="module")
def compose():
    return yaml.safe_load((DOCKER / "compose.yml").read_text())


@pytest.fixture(scope="module")
def worker(compose):
    return compose["services"]["worker0"]


def filled_in(text: str, **variables: str) -> str:
    """Substitute ``${NAME:-default}`` and ``${NAME:?message}`` as compose does."""

    def value(found: re.Match[str]) -> str:
        name, kind, otherwise = found.groups()
        if not variables.get(name):
            assert kind == ":-", otherwise
        return variables.get(name) or otherwise

    return re.sub(r"\$\{(\w+)(:[-?])(.*?)\}", value, text)


def mounts(worker, **variables: str) -> dict[str, str]:
    """Volume or folder mounted at each path of the container."""
    pairs = [filled_in(volume, **variables).split(":") for volume in worker["volumes"]]
    return {place: source for source, place in pairs}


def test_mounts_are_volumes_that_the_worker_can_write(compose, worker):
    """A new Docker volume gets the owner of its path in the image. Bind mounts belong to root."""
    volumes = mounts(worker)
    assert set(volumes.values()) <= compose["volumes"].keys()
    owned = re.findall(
        r"(?m)^chown -R real2sim:real2sim (.*)$", (DOCKER / "entry-layer.sh").read_text()
    )
    assert volumes.keys() <= set(owned[0].split())


def test_scenes_can_be_a_folder_of_the_host(worker):
    assert mounts(worker, REAL2SIM_SCENES="/data/scenes")["/scenes"] == "/data/scenes"


def test_a_worker_can_only_write_to_its_volumes_and_tmp(worker):
    assert worker["read_only"] is True
    assert [place.split(":")[0] for place in worker["tmpfs"]] == ["/tmp"]


def test_a_worker_has_no_capabilities(worker):
    assert worker["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in worker["security_opt"]


def test_a_worker_has_resource_limits(worker):
    assert worker["mem_limit"]
    assert worker["pids_limit"] <= 1024
    assert set(worker["logging"]["options"]) == {"max-size", "max-file"}


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_runs_as_a_numeric_non_root_user(name):
    lines = (DOCKER / name).read_text().splitlines()
    users = [line.split()[1] for line in lines if line.startswith("USER ")]
    assert users == ["10001:10001"]
    assert "useradd --uid 10001 --gid 10001" in (DOCKER / "entry-layer.sh").read_text()


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_build_fails_if_kernels_are_left_to_compile(name):
    assert "real2sim doctor --warm && real2sim doctor --warmed" in (DOCKER / name).read_text()


def test_the_gpu_image_build_requires_cuda_except_for_the_device():
    text = (DOCKER / "Dockerfile.gpu").read_text()
    assert "real2sim doctor --build-gpu" in text
    build, check = text.index("doctor --build-gpu"), text.index("doctor --need-cuda")
    assert build < check
    assert "doctor --need-cuda --without-device" in text
    # Otherwise a worker without a device would render on the CPU and only log it.
    assert "REAL2SIM_BACKEND=cuda" in text


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_supports_postgresql(name):
    assert re.search(r"'(?:\.|real2sim)\[.*postgres.*\]'", (DOCKER / name).read_text())


def pins(path: Path) -> dict[str, str]:
    found = re.findall(r"(?m)^([A-Za-z0-9._-]+)==([^ ;\n\\]+)", path.read_text())
    return {name.lower().replace("_", "-").replace(".", "-"): version for name, version in found}


IMAGE_PINS = DOCKER / "requirements.txt"


def test_an_image_installs_only_packages_with_a_hash():
    requirements = re.split(r"(?m)^(?=[A-Za-z])", IMAGE_PINS.read_text())[1:]
    assert len(requirements) > 40
    assert [r.split()[0] for r in requirements if "--hash=sha256:" not in r] == []


def test_an_image_has_the_tested_versions():
    tested = pins(DOCKER.parent / "constraints.txt")
    elsewhere = re.findall(
        r"(?m)^(\S+)==.* sys_platform == '(?:win32|emscripten)' \\$", IMAGE_PINS.read_text()
    )
    image = {name: v for name, v in pins(IMAGE_PINS).items() if name not in elsewhere}
    assert {name: v for name, v in image.items() if tested.get(name) != v} == {}


def test_all_requirements_of_a_worker_are_pinned_for_images():
    folders = (DOCKER.parent / "client", DOCKER.parent)
    sdk, project = (tomllib.loads((f / "pyproject.toml").read_text())["project"] for f in folders)
    extras = project["optional-dependencies"] | {"server": sdk["dependencies"]}
    installed = re.search(r"'real2sim\[(.*)\]'", (DOCKER / "Dockerfile.cpu").read_text())
    needed = [*project["dependencies"], *(n for e in installed[1].split(",") for n in extras[e])]
    needed += [need for need in requires("torch") if "extra ==" not in need]
    names = {re.split(r"[><=~!\[; ]", need)[0].lower().replace("_", "-") for need in needed}
    names.remove("real2sim")
    makefile = (DOCKER.parent / "Makefile").read_text().replace("\\\n", " ")
    with_torch = re.search(r"(?m)^WITH_TORCH := (.*)$", makefile)
    assert names - pins(IMAGE_PINS).keys() <= set(with_torch[1].split())


def test_all_packages_of_an_image_are_in_the_third_party_notices():
    rows = (DOCKER.parent / "THIRD_PARTY.md").read_text()
    missing = [n for n, v in pins(IMAGE_PINS).items() if f"| {n} | {v} |" not in rows]
    assert missing == []


# --- running the files ------------------------------------------------------------------


def last_stage(name: str) -> dict[str, str]:
    """Instructions of an image's last stage. Repeated instructions are joined in one line."""
    text = (DOCKER / name).read_text().replace("\\\n", " ")
    found: dict[str, str] = {}
    for word, rest in re.findall(r"(?m)^([A-Z]+) +(.*)$", text[text.rindex("\nFROM ") :]):
        found[word] = f"{found.get(word, '')} {rest}".strip()
    return found


def test_a_compose_worker_serves_the_demo_street_with_its_token(
    compose, worker, tmp_path, worker_kernels
):
    """Runs the process that compose starts, with folders as volumes and a free port."""
    token = secrets.token_hex(16)
    folders = {place: tmp_path / source for place, source in mounts(worker).items()}
    for folder in folders.values():
        folder.mkdir()
    image = last_stage(Path(worker["build"]["dockerfile"]).name)
    variables = dict(pair.split("=", 1) for pair in shlex.split(image["ENV"]))
    given = {name: filled_in(v, REAL2SIM_TOKEN=token) for name, v in worker["environment"].items()}
    environment = {n: v for n, v in variables.items() if n.startswith("REAL2SIM_")} | given
    for name, value in environment.items():
        environment[name] = str(folders.get(value, value))
    assert environment["REAL2SIM_HOST"] == "0.0.0.0"
    assert worker["ports"] == [f"127.0.0.1:8600:{environment['REAL2SIM_PORT']}"]
    environment |= {"REAL2SIM_HOST": "127.0.0.1", "REAL2SIM_PORT": "0"}
    entry, arguments = json.loads(image["ENTRYPOINT"]), worker["command"]
    assert entry == ["real2sim"]

    log_file = tmp_path / "log"
    process = start_real2sim(arguments, log_file=log_file, environment=environment)
    try:
        url = printed_url(process, log_file)
        with connect(url, token="") as stranger, pytest.raises(UnauthorizedError):
            stranger.scenes.list()
        with connect(url, token=token) as client:
            client.wait_ready()
            assert [scene.scene for scene in client.scenes.list()] == ["demo_street"]
            picture = client.scenes.render("demo_street", camera="front", width=120).array
    finally:
        process.kill()
        process.join()
    assert picture.shape[1] == 120
    assert picture.std() > 20  # A street has several colours.
    assert (folders["/var/lib/real2sim"] / "real2sim.db").exists()


def build_options() -> list[str]:
    """Options of ``buildah bud``, from ``BUILDAH_OPTIONS``. Skips if no image can be built."""
    missing = [name for name in ("buildah", "debootstrap") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"there is no {' and no '.join(missing)} (make system-packages)")
    if os.geteuid() != 0:
        pytest.skip("only root builds images by buildah in a chroot")
    if subprocess.run(["unshare", "--mount", "true"], check=False, capture_output=True).returncode:
        pytest.skip("this machine lets root mount nothing")
    if options := os.environ.get("BUILDAH_OPTIONS"):
        return shlex.split(options)
    index = re.search(r"(?m)^ARG TORCH_INDEX=(.*)$", (DOCKER / "Dockerfile.cpu").read_text())
    try:
        urllib.request.urlopen(f"{index[1]}/torch/", timeout=20).close()
    except OSError as error:
        pytest.skip(f"{index[1]}: {error}; set BUILDAH_OPTIONS, '--build-arg TORCH_INDEX=' say")
    return []


@pytest.mark.slow
@pytest.mark.timeout(5400)
def test_the_cpu_image_builds_and_is_ready_as_its_user_on_a_read_only_root():
    """Takes some ten minutes of CPU time, nearly all of it to compile kernels."""
    command = ["nice", "-n", "10", str(DOCKER / "build.sh"), "cpu", "--", *build_options()]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    *_, last = done.stdout.strip().splitlines()
    assert last.startswith("real2sim:cpu is ready as user 10001:10001 on a read-only root")
