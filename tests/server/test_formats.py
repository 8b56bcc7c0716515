"""The code blocks of the pages about formats, people and operation run, as the pages promise."""

from __future__ import annotations

import configparser
import hashlib
import itertools
import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import cv2
import httpx2
import numpy as np
import pytest
import yaml
from pydantic import BaseModel
from safetensors import safe_open
from typer.testing import CliRunner
from websockets import Subprotocol
from websockets.sync.client import connect

import real2sim
from real2sim.cli import build_app
from real2sim.planners import FollowRoute, run_episode
from real2sim_proto import DRIVE_SUBPROTOCOL, decode, encode
from real2sim_proto.drive import Envelope, EventType, ServerEnvelope
from real2sim_proto.schema import MODELS
from real2sim_server.datasets.writers import WRITERS
from real2sim_server.demo.street import unpack_street
from real2sim_server.logs import LogError, open_log
from real2sim_server.maps import read_map
from real2sim_server.render.modalities import unregister
from real2sim_server.scene import GaussianCloud, Trajectory
from real2sim_server.scene.asset import person_asset
from real2sim_server.scene.io import save_asset
from real2sim_server.scene.io.document import (
    CameraPart,
    GroundPart,
    ObjectPart,
    SceneContent,
    SceneDocument,
)
from real2sim_server.service.accounts import TokenLimits, read_token_file
from real2sim_server.service.http.telemetry import Metrics
from real2sim_server.service.serve import running_worker
from real2sim_server.service.shared_objects import FolderObjects, S3Objects, open_objects
from real2sim_server.settings import OTHER_VARIABLES, Settings
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log
from tests.pages import LIMIT_S, REPOSITORY, Page

pytestmark = [pytest.mark.network, pytest.mark.timeout(5400)]


def without_numbers(text: str) -> str:
    return re.sub(r"\d+", "#", text)


@pytest.mark.slow
def test_log_format(page: Callable[[str], Page]) -> None:
    with page("docs/log_format.md") as formats:
        tree = formats.block("my_drive/")
        small = formats.json('"format": "real2sim-log"')
        write_log(formats.folder / "small", small)
        log = open_log(formats.folder / "small")
        assert log.name == small["name"]
        assert log.lidar(1).points.shape == (50, 3)
        formats.python("T_map_imu")
        formats.python("class Recording")
        files = re.findall(r"^  (\S+)", tree, re.M)
        assert len(files) == 4
        assert all((formats.folder / "my_drive" / name).exists() for name in files)
        told = formats.shell("--check").splitlines()
        assert len(list((formats.folder / "pictures").iterdir())) == 4
        assert told[-1] == "no problems found"
        assert told[-2].endswith("5 images and 5 sweeps read")
        damaged = formats.block("left out  sweeps")
        damage(formats.folder / "my_drive/lidar")
        shown = command("log-info", "my_drive", "--check", code=1)
        assert without_numbers(damaged) in without_numbers(shown)
        with pytest.raises(LogError, match="2 of 5 frames lack an image, a sweep or a pose"):
            formats.python("usable_log")


def write_log(folder: Path, document: dict[str, Any]) -> None:
    """A log of this ``log.json``, with images and sweeps as the page says that they are named."""
    (folder / "lidar").mkdir(parents=True)
    (folder / "log.json").write_text(json.dumps(document))
    sweep = {
        "points": np.ones((50, 3), np.float32), "intensity": np.ones(50, np.float32),
        "offset_us": np.zeros(50, np.int32), "origin": np.zeros(3, np.float32),
    }  # fmt: skip
    for frame in range(len(document["frame_times_us"])):
        if document["lidar"]:
            np.savez(folder / f"lidar/{frame:06}.npz", **sweep)
        for camera in document["cameras"]:
            images = folder / "images" / camera["name"]
            images.mkdir(parents=True, exist_ok=True)
            image = np.zeros((camera["height"], camera["width"], 3), np.uint8)
            cv2.imwrite(str(images / f"{frame:06}.png"), image)


def damage(sweeps: Path) -> None:
    """One sweep without its origin, one of points with four columns."""
    sweep = dict(np.load(sweeps / "000001.npz"))
    wide = np.zeros((len(sweep["points"]), 4), np.float32)
    np.savez(sweeps / "000003.npz", **sweep | {"points": wide})
    del sweep["origin"]
    np.savez(sweeps / "000001.npz", **sweep)


@pytest.mark.slow
def test_maps(page: Callable[[str], Page]) -> None:
    with page("docs/maps.md") as maps:
        unpack_street(maps.folder, "street.r2s")
        street = generate_log(SyntheticConfig(frames=22, hz=2.0))
        write_town(maps.folder / "town.xodr", street, yaw=0.1, x=250.0, y=-40.0)
        write_log(maps.folder / "drive", document_of(street))
        names = maps.python("read_map")
        assert names["found"].lane_id == "7.0.-1"
        assert names["found"].inside
        assert names["way"] == ("7.0.-1", "9.0.-1")
        assert names["on_road"].tolist() == [True]
        middle = names["graph"].lane("7.0.-1").at(12.5)
        np.testing.assert_allclose(names["place"], middle, atol=0.1)
        told = maps.shell("--from town.xodr")
        fits = np.array(re.findall(r"│ (?:turned|moved).*│ (\S+)", told), float).reshape(2, 3)
        np.testing.assert_allclose(fits[:, 0], 0.1, atol=0.01)
        np.testing.assert_allclose(fits[:, 1:], [[250.0, -40.0]] * 2, atol=4.0)  # Along the street.
        sources = re.findall(r"│ source +│ (.+?) +│", told)
        assert sources == ["opendrive town.xodr"] * 5 + ["log"]
        assert cv2.imread(str(maps.folder / "lanes.png")) is not None
        assert set(read_map(maps.folder / "lanes.json").roads) == {"7", "9"}


def write_town(file: Path, street: SyntheticLog, *, yaw: float, x: float, y: float) -> None:
    """The lanes of a street as OpenDRIVE, whose frame lies so in that of the street."""
    right, left = (street.lanes.lanes[f"lane_{side}"].centre[:, :2] for side in ("right", "left"))
    line = (right[:166] + left[::-1][:166]) / 2 - [x, y]
    line = line @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    lane = '<lane id="{}" type="driving"><width sOffset="0" a="3.4" b="0" c="0" d="0"/>{}</lane>'
    roads = ""
    for road, other, points in (("7", "successor", line[:90]), ("9", "predecessor", line[89:])):
        steps = np.diff(points, axis=0)
        lengths = np.hypot(*steps.T)
        at = np.concatenate([[0], np.cumsum(lengths)]).tolist()
        pieces = ""
        for s, (x_start, y_start), heading, length in zip(
            at[:-1], points[:-1].tolist(), np.arctan2(*steps.T[::-1]).tolist(), lengths.tolist(),
            strict=True,
        ):  # fmt: skip
            pieces += (
                f'<geometry s="{s!r}" x="{x_start!r}" y="{y_start!r}" hdg="{heading!r}" '
                f'length="{length!r}"><line/></geometry>'
            )
        end = "start" if other == "successor" else "end"
        link = f'<{other} elementType="road" elementId="{16 - int(road)}" contactPoint="{end}"/>'
        sides = ""
        for side, number in (("left", 1), ("right", -1)):
            goes_on = f'<link><{other} id="{number}"/></link>'
            sides += f"<{side}>{lane.format(number, goes_on)}</{side}>"
        roads += (
            f'<road id="{road}" length="{at[-1]!r}" junction="-1"><link>{link}</link><planView>'
            f'{pieces}</planView><lanes><laneSection s="0">{sides}</laneSection></lanes></road>'
        )
    file.write_text(f'<OpenDRIVE><header revMajor="1" revMinor="7"/>{roads}</OpenDRIVE>')


def document_of(log: SyntheticLog) -> dict[str, Any]:
    """A ``log.json`` of what moves in a log, with one small camera and no LiDAR."""
    camera = log.rig["front"]

    def way(trajectory: Trajectory) -> dict[str, Any]:
        names = ("times_us", "positions", "quaternions")
        return {name: getattr(trajectory, name).tolist() for name in names}

    return {
        "format": "real2sim-log", "version": 1, "name": "drive", "lidar": False,
        "provenance": {},
        "frame_times_us": log.frame_times_us.tolist(),
        "cameras": [{
            "name": "front", "width": 32, "height": 24, "K": [[30, 0, 16], [0, 30, 12], [0, 0, 1]],
            "T_vehicle_camera": camera.T_vehicle_camera.tolist(),
        }],
        "ego": {"size": [4.6, 1.85, 1.6], **way(log.ego)},
        "tracks": [
            {"object_id": t.object_id, "category": t.category, "size": list(t.size),
             **way(t.trajectory)}
            for t in log.tracks
        ],
    }  # fmt: skip


def test_scene_format(page: Callable[[str], Page]) -> None:
    with page("docs/scene_format.md") as formats:
        told = formats.path.read_text("utf-8")
        tree = re.findall(r"^  (\S+\.\w+) +(.+)", formats.block("street.r2s/"), re.M)
        unpack_street(formats.folder, "street.r2s")
        save_asset(person_asset("anna", "woman"), formats.folder / "anna.r2s")
        needed = {name for name, what in tree if "where a scene has" not in what}
        written = {
            p.name for n in ("street", "anna") for p in (formats.folder / f"{n}.r2s").iterdir()
        }
        assert written == needed
        street, anna = (
            json.loads((formats.folder / f"{name}.r2s/scene.json").read_text())
            for name in ("street", "anna")
        )
        assert street["version"] == anna["version"] == 1
        assert street["files"] == {
            name: (formats.folder / "street.r2s" / name).stat().st_size for name in street["files"]
        }
        hashed = formats.block('"content"').strip()
        for document in (street, anna):
            text = hashed
            for key in ("content", "kind"):
                compact = json.dumps(document[key], sort_keys=True, separators=(",", ":"))
                text = text.replace(f"<{key}>", compact)
            assert hashlib.sha256(text.encode("ascii")).hexdigest() == document["content_hash"]
        with safe_open(formats.folder / "anna.r2s/asset.safetensors", "numpy") as file:
            for part in (anna["content"]["cloud"], anna["content"]["figure"]):
                for name, digest in part["tensors"].items():
                    assert hashlib.sha256(file.get_tensor(name).tobytes()).hexdigest() == digest
        top, content = (
            keys_of(told, after) for after in ("## scene.json", "`content` of a scene:")
        )
        assert set(top) == set(SceneDocument.model_fields)
        assert set(content) == set(SceneContent.model_fields)
        for row, part in (("cameras", CameraPart), ("objects", ObjectPart), ("ground", GroundPart)):
            assert set(part.model_fields) <= set(re.findall(r"`(\w+)`", content[row]))


def keys_of(told: str, *after: str) -> dict[str, str]:
    """Rows of the first table that follows, by their first column."""
    for words in after:
        told = told.split(words, 1)[1]
    table = told.split("\n|", 1)[1].split("\n\n", 1)[0]
    return dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", table, re.M))


@pytest.mark.slow
def test_people(
    page: Callable[[str], Page], demo_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("REAL2SIM_URL", demo_url)
    with page("docs/people.md") as people:
        assert people.python("skin(body")["vertices"].shape == (3740, 3)
        names = people.python("plan_gait")
        assert names["vertices"].shape == (2, 3740, 3)
        small = " --frames 2 --width 64 --height 48"
        people.shell("--pedestrians 10", {"--cyclists 2": "--cyclists 2" + small})
        tracks = open_log(people.folder / "out/log").tracks
        count = Counter(track.category for track in tracks)
        assert (count["pedestrian"], count["cyclist"]) == (10, 2)
        people.python("generate_log")
        present = len(names["truth"].tracks)
        assert 0 < present <= 12
        assert names["truth"].joints.shape == (present, 22, 3)
        assert names["truth"].keypoints.shape == (present, 17, 3)
        assert [names[n].shape for n in ("rgb", "depth", "parts", "flow")] == [
            (320, 480, 3), (320, 480), (320, 480), (320, 480, 2),
        ]  # fmt: skip
        assert names["parts"].dtype == np.uint8
        assert (names["parts"] > 0).any()
        people.python("person_asset")
        assert isinstance(names["posed"], GaussianCloud)
        assert names["points"].shape == (17, 3)
        people.python("assets.person")
        people.python("set_gait")
        (anna,) = (o for o in names["scenario"].objects.values() if o.info.category == "pedestrian")
        steps = np.diff([anna.pose(t).position for t in (0.0, 4.0)], axis=0)
        np.testing.assert_allclose(steps[0, :2], [5.6, 0.1], atol=1e-6)
        assert names["scenario"].history().entries[-1].operations[0].op == "set_gait"
        names["client"].close()


def test_extending_images(page: Callable[[str], Page]) -> None:
    with page("docs/extending/images.md") as images:
        alpha = images.python("SensorModality")["ALPHA"]
        unregister("alpha")
        png = alpha.encode(np.arange(6, dtype=np.uint8).reshape(2, 3), "png", 90)
        decoded = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        assert decoded.tolist() == [[0, 1, 2], [3, 4, 5]]
        assert alpha.shape(3, 2) == (2, 3)


MESSAGES = {
    model.model_fields["type"].default: model
    for model in MODELS.values()
    if issubclass(model, Envelope)
}


@pytest.mark.slow
def test_protocol(page: Callable[[str], Page], demo_url: str) -> None:
    with page("docs/protocol.md") as protocol:
        traces = [
            list(messages(protocol.block(words)))
            for words in ('role:"controller"', "resume:{", "attach", "lidars:[{")
        ]
        assert [len(trace) for trace in traces] == [6, 1, 5, 2]
        for sender, message in itertools.chain(*traces):
            model = MESSAGES[message["type"]]
            assert issubclass(model, ServerEnvelope) == (sender == "S")
            check_names(message, model)
        drive(demo_url, traces[0])
        told = protocol.path.read_text("utf-8")
        assert set(keys_of(told, "### Observations", "`reason` is")) == set(get_args(EventType))


def drive(url: str, trace: list[tuple[str, dict[str, Any]]]) -> None:
    """Send what the client sends; what the worker answers has the members that are shown."""
    made = httpx2.post(f"{url}/v1/sessions?scene=demo_street", json={}).raise_for_status().json()
    protocols = [Subprotocol(DRIVE_SUBPROTOCOL)]
    with connect(made["ws_url"], subprotocols=protocols, compression=None, proxy=None) as socket:
        for sender, message in trace:
            if message["type"] == "hello":
                message["token"] = made["token"]
            if message["type"] == "action":
                message["plan"] |= {"times_us": [1_000_000], "poses": [[5.0, 0.0, 0.0]]}
            if sender == "C":
                socket.send(encode(message))
                continue
            answer = decode(socket.recv(timeout=LIMIT_S, decode=False))
            while answer["type"] == "progress":
                answer = decode(socket.recv(timeout=LIMIT_S, decode=False))
            assert message.keys() - {"..."} <= answer.keys()
            said = ("v", "type", "id", "step", "t_us")
            assert [message.get(k, answer.get(k)) for k in said] == [answer.get(k) for k in said]


def messages(trace: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Who sends what in a trace; what is left out is the member ``...``."""
    for sender, text in re.findall(r"^([CS])  (\{.*?\})(?=\n[CS] |\s*\Z)", trace, re.M | re.S):
        plain = re.sub(r"<[^>]*>", "array", text)
        yield sender, yaml.safe_load(re.sub(r"(\w):", r"\1: ", plain))


def check_names(message: dict[str, Any], model: type[BaseModel]) -> None:
    """Every member is one of the model, also deep inside."""
    for name, value in message.items():
        if name == "...":
            continue
        assert name in model.model_fields, (model, name)
        inner = models_in(model.model_fields[name].annotation)
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, dict) and inner:
                known = [m for m in inner if part.keys() - {"..."} <= m.model_fields.keys()]
                assert known, (model, name, part)
                check_names(part, known[0])


def models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for part in get_args(annotation) for m in models_in(part)]


@pytest.mark.slow
def test_datasets(page: Callable[[str], Page], demo_url: str) -> None:
    with page("docs/datasets.md") as datasets:
        unpack_street(datasets.folder, "street.r2s")
        Path("edits.json").write_text('[{"op": "delete", "object_id": "car_6"}]')
        with real2sim.connect(demo_url) as sim, sim.session("demo_street") as session:
            run_episode(session, FollowRoute(), horizon=3)
            session.save_recording("drive.r2e")
        small = {"SCENE": "street.r2s --end-us 100000 --cameras front --width 160 --no-flow"}
        datasets.shell("--format kitti", small)
        sets = {
            "set": {"kitti", "coco"}, "edited": {"nuscenes"}, "episode": {"webdataset"},
            "lidar": {"nuscenes", "labels"}, "look": {"pictures"},
        }  # fmt: skip
        assert {path.name for path in Path("out").iterdir()} == set(sets)
        for name, formats in sets.items():
            made = {path.name for path in Path("out", name).iterdir()}
            assert made == formats | {"preview", "manifest.json", "LICENSE.txt"}
        seen = [json.loads(Path("out", n, "manifest.json").read_text()) for n in ("set", "edited")]
        cars = [manifest["statistics"]["tracks"]["car"] for manifest in seen]
        assert cars[1] == cars[0] - 1
        Path("sweep.json").write_text(datasets.block('"draws": 4'))
        one = planned()
        assert planned("--sweep", "sweep.json")["frames"] == 5 * 4 * one["frames"]
        Path("rig.json").write_text(datasets.block('"hfov_deg"'))
        rig = planned("--rig", "rig.json")
        assert rig["images"] == 2 * rig["frames"]
        ray = {f"real2sim export-dataset SCENE --out out/{n}": ":" for n in ("ray", "cluster")}
        datasets.shell("--workers 4", ray | small | {"--workers 4": "--workers 2"})
        assert Path("out/four/nuscenes").is_dir()
        assert "ray" in extras()
        datasets.block("bench detector")
        told = datasets.path.read_text("utf-8")
        assert set(keys_of(told, "\n## Formats")) == {writer.name for writer in WRITERS}


def planned(*options: str) -> dict[str, Any]:
    """What exporting a tenth of a second would make."""
    words = "export-dataset street.r2s --out out/planned -f labels --dry-run --json planned.json"
    told = CliRunner().invoke(build_app(), [*words.split(), "--end-us", "100000", *options])
    assert told.exit_code == 0, told.output
    return json.loads(Path("planned.json").read_text())


def command(*words: str, code: int = 0) -> str:
    """Both outputs of a call of ``real2sim`` that ends with this exit code."""
    done = subprocess.run(
        [sys.executable, "-m", "real2sim", *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    return done.stdout + done.stderr


def extras() -> set[str]:
    with (REPOSITORY / "client" / "pyproject.toml").open("rb") as file:
        return set(tomllib.load(file)["project"]["optional-dependencies"])


@pytest.mark.slow
def test_storage(page: Callable[[str], Page], worker_kernels: None) -> None:
    with page("docs/storage.md") as storage:
        state = storage.folder / "state_folder"
        folder = {"/var/lib/real2sim": str(state)}
        settings = Settings(data_dir=state, port=0, backend="cpu", log_level="error")
        unpack_street(state / "scenes", "demo_street")
        with running_worker(settings) as worker, real2sim.connect(worker.url) as sim:
            refused = storage.block("error:").replace("/var/lib/real2sim", str(state))
            said = command("serve", "--data", str(state), "--port", "0", code=1)
            place = "(process 4711 on host7)"
            told = re.sub(r"\(process \d+ on \S+\)", place, said)
            assert refused.strip() in told
            lines = storage.block("OBJECTS_URL").splitlines()
            urls = [shlex.split(line, comments=True)[1].partition("=")[2] for line in lines]
            assert [type(open_objects(url)) for url in urls] == [FolderObjects, S3Objects]
            kept = sim.scenarios.create("demo_street", "kept").scenario_id
            storage.shell("real2sim backup", folder)
            sim.scenarios.delete(kept)
        restore = ("restore", "monday.backup", "--data", str(state))
        assert "--overwrite" in command(*restore, code=1)
        storage.shell("real2sim restore", folder)
        with running_worker(settings) as worker, real2sim.connect(worker.url) as sim:
            assert sim.scenarios.get(kept).info.name == "kept"
        told = storage.shell("store status", folder)
        assert re.search(r"schema (\d+); this program's is \1\nnothing to do", told)


DOCKER = {"-f": Path.is_file, "-k": Path.is_dir}


@pytest.mark.slow
def test_operations(page: Callable[[str], Page], monkeypatch: pytest.MonkeyPatch) -> None:
    with page("docs/operations.md") as operations:
        compose = operations.block("docker compose")
        named = re.findall(r"(-f|-k) (\S+)", compose)
        assert len(named) == 5
        assert all(DOCKER[option](REPOSITORY / name) for option, name in named)
        unit = configparser.ConfigParser()
        unit.optionxform = str  # type: ignore[assignment, method-assign]
        unit.read_string(operations.block("[Service]"))
        service, settings = unit["Service"], Settings()
        assert service["ExecStart"].endswith("/bin/real2sim serve")
        assert int(service["TimeoutStopSec"]) > settings.drain_seconds + settings.graceful_seconds
        assert int(service["LimitNOFILE"]) >= settings.max_connections + 256
        services = yaml.safe_load(operations.block("shm_size"))["services"]
        assert services["planner"]["ipc"] == "service:worker"
        tokens = operations.folder / "tokens.json"
        told = operations.shell("token add alice", {"/etc/real2sim/tokens.json": str(tokens)})
        alice = told.splitlines()[0]
        held = read_token_file(tokens).tokens
        assert [(t.name, t.role) for t in held] == [("watcher", "observe"), ("nightly", "drive")]
        assert held[1].limits == TokenLimits(
            requests_per_second=200, sessions=8, jobs=4,
        )  # fmt: skip
        assert alice not in tokens.read_text()
        proxy = operations.block("proxy_pass")
        assert proxy.count("{") == proxy.count("}")
        assert "proxy_set_header Host $http_host;" in proxy
        gigabytes = int(re.findall(r"client_max_body_size (\d+)g", proxy)[0])
        assert gigabytes << 30 >= settings.max_upload_bytes
        state, scenes = operations.folder / "kept", operations.folder / "scenes"
        here = {"/backup": "backup", "rsync -a": "cp -r"}
        state.mkdir()
        scenes.mkdir()
        monkeypatch.setenv("REAL2SIM_DATA_DIR", str(state))
        monkeypatch.setenv("REAL2SIM_SCENES_DIR", str(scenes))
        command("store", "migrate")
        operations.shell("real2sim backup", here)
        operations.shell("real2sim restore", {"/backup": "backup", "2026-01-31": "$(date +%F)"})


DEFAULT = r"`REAL2SIM_(\w+)`(?: \| |\s\()(\d+)( [GM]iB)?(?: \||\))"
UNITS = {"": 1, " MiB": 1 << 20, " GiB": 1 << 30}


def test_settings_defaults_and_metrics_of_the_pages_are_those_of_a_worker() -> None:
    known = {f"REAL2SIM_{name.upper()}" for name in Settings.model_fields} | OTHER_VARIABLES
    tests = {"REAL2SIM_TEST_WRITES", "REAL2SIM_TEST_KILLS", "REAL2SIM_TEST_EPISODES"}
    for name in ("operations", "storage", "gpu", "protocol"):
        text = (REPOSITORY / f"docs/{name}.md").read_text("utf-8")
        assert set(re.findall(r"REAL2SIM_[A-Z_]*[A-Z]", text)) <= known | tests
        for setting, number, unit in re.findall(DEFAULT, text):
            value = int(number) * UNITS[unit]
            assert Settings.model_fields[setting.lower()].default == value, setting
    metrics = {family.name for family in Metrics().registry.collect()}
    told = (REPOSITORY / "docs/operations.md").read_text("utf-8")
    named = set(re.findall(r"`(real2sim_\w+?)(?:_total)?`", told.split("| metric |")[1]))
    assert {n for n in named if "_token_" not in n} <= metrics


@pytest.mark.slow
def test_gpu(page: Callable[[str], Page], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    with page("docs/gpu.md") as gpu:
        install = gpu.block("pip install")
        asked = re.findall(r"real2sim\[(\S+)\]", install)[0].split(",")
        assert set(asked) <= extras()
        assert "error: CUDA is not usable" in command("doctor", "--need-cuda", code=1)
        Path("scenes").mkdir()
        serve = ("serve", "--scenes", "scenes", "--data", "data", "--port", "0")
        assert "cuda" in command(*serve, "--backend", "cuda", code=1)
        assert "--gpu-check" in gpu.block("gpu.md")
        gpu.shell("--backend nvrtc", {"real2sim serve": ": ", "-kernels ": "-kernels --json it "})
        compiled = {kernel["kernel"] for kernel in json.loads(Path("it").read_text())["kernels"]}
        assert "blend" in compiled


@pytest.fixture(scope="module")
def demo_url(tmp_path_factory: pytest.TempPathFactory, worker_kernels: None) -> Iterator[str]:
    """A worker on the demo's street."""
    root = tmp_path_factory.mktemp("worker")
    unpack_street(root / "scenes", "demo_street")
    settings = Settings(data_dir=root, port=0, backend="cpu", log_level="error")
    with running_worker(settings) as worker:
        yield worker.url
