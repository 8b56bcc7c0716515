"""Fuzz targets for all file readers: valid samples, how to read them, and documented errors.

A sample consists of named parts: the file itself, or the content of an archive, a compressed stream
or a folder. Parts are damaged and then reassembled, so that checksums of the container do not hide
the damage.
"""

from __future__ import annotations

import contextlib
import gzip
import importlib.util
import io
import json
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from real2sim_proto import CodecError, decode, encode
from real2sim_server.console import CommandError
from real2sim_server.scene import Asset, SceneError
from real2sim_server.scene.io import (
    import_splats,
    load_asset,
    load_scene,
    read_packed,
    read_scene_summary,
    save_asset,
    save_scene,
    write_packed,
    write_splats,
)
from real2sim_server.scene.io.container import content_hash
from real2sim_server.scene.io.spz import Spz

Parts = dict[str, bytes]
TESTS = Path(__file__).resolve().parents[1]
MIB = 1 << 20


@dataclass(frozen=True)
class Target:
    """A reader under test.

    Attributes:
        name: name of the target.
        sample: writes the parts of valid files to an empty folder.
        write: assembles parts below a folder. Returns the path to read.
        read: reads it, and processes it as the program does.
        errors: documented errors.
    """

    name: str
    sample: Callable[[Path], list[Parts]]
    write: Callable[[Parts, Path], Path]
    read: Callable[[Path], Any]
    errors: tuple[type[Exception], ...]


def scene() -> Any:
    """The small street of the server's tests."""
    spec = importlib.util.spec_from_file_location("server_conftest", TESTS / "server/conftest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    whole = module.make_tiny_scene()
    # Small tensors, so that damage hits headers as often as values.
    index = torch.arange(20)
    objects = {k: replace(o, cloud=o.cloud.select(index)) for k, o in whole.objects.items()}
    return replace(whole, background=whole.background.select(index), objects=objects)


# --- assembly ---------------------------------------------------------------------------------


def plain(suffix: str) -> Callable[[Parts, Path], Path]:
    def write(parts: Parts, folder: Path) -> Path:
        path = folder / f"file{suffix}"
        path.write_bytes(parts["file"])
        return path

    return write


def zipped(suffix: str) -> Callable[[Parts, Path], Path]:
    def write(parts: Parts, folder: Path) -> Path:
        path = folder / f"file{suffix}"
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in parts.items():
                archive.writestr(name or "x", data)
        return path

    return write


def gzipped(suffix: str) -> Callable[[Parts, Path], Path]:
    def write(parts: Parts, folder: Path) -> Path:
        path = folder / f"file{suffix}"
        path.write_bytes(gzip.compress(parts["file"], 1))
        return path

    return write


def bundle(parts: Parts, folder: Path) -> Path:
    """A bundle whose hash matches its damaged content, as a deliberate attack would have."""
    path = folder / "file.r2s"
    path.mkdir(exist_ok=True)
    for file in path.iterdir():
        file.unlink()
    for name, data in parts.items():
        (path / name).write_bytes(data)
    try:
        document = json.loads(parts["scene.json"])
        document["content_hash"] = content_hash(document["kind"], document["content"])
        for name in document["files"]:
            document["files"][name] = len(parts[name])
        (path / "scene.json").write_text(json.dumps(document))
    except (KeyError, ValueError, TypeError, RecursionError):
        pass
    return path


def parts_of_zip(path: Path) -> Parts:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


# --- samples ----------------------------------------------------------------------------------


def splats(suffix: str) -> Callable[[Path], list[Parts]]:
    def sample(folder: Path) -> list[Parts]:
        cloud = scene().background
        samples = []
        for degree in (0, 1, 3):
            path = folder / f"sample{suffix}"
            if suffix == ".spz4":
                Spz(version=4).write(cloud.with_sh_degree(degree), path)
            else:
                write_splats(cloud.with_sh_degree(degree), path)
            data = path.read_bytes()
            inner = gzip.decompress(data) if suffix == ".spz" else data
            samples.append({"file": inner})
        return samples

    return sample


def bundle_sample(folder: Path) -> list[Parts]:
    save_scene(scene(), folder / "a.r2s")
    return [{p.name: p.read_bytes() for p in (folder / "a.r2s").iterdir()}]


def asset_sample(folder: Path) -> list[Parts]:
    save_asset(Asset("a", "car", (4.0, 2.0, 1.5), scene().background), folder / "a.r2a")
    return [{p.name: p.read_bytes() for p in (folder / "a.r2a").iterdir()}]


def packed_sample(folder: Path) -> list[Parts]:
    write_packed(scene(), folder / "a.r2s.zip")
    return [parts_of_zip(folder / "a.r2s.zip")]


def recording_sample(folder: Path) -> list[Parts]:
    (folder / "a.r2e").write_bytes(recorded())
    return [parts_of_zip(folder / "a.r2e")]


def recorded() -> bytes:
    """A short episode with a plan, an edit and an image."""
    from real2sim_proto.episode import ResetSpec
    from real2sim_proto.operations import Delete
    from real2sim_proto.plans import TrajectoryPlan
    from real2sim_server.edit import ScenarioState
    from real2sim_server.world.recording import record, to_bytes
    from real2sim_server.world.replay import (
        Entry,
        Replayer,
        action_payload,
        edit_payload,
        reset_payload,
    )

    street = scene()
    log = [Entry("reset", 0, reset_payload(ResetSpec(on_collision="continue")))]
    for step in range(3):
        times = [100_000 * (step + k + 1) for k in range(5)]
        plan = TrajectoryPlan(times_us=times, poses=[(k + 1.0, 0.0, 0.0) for k in range(5)])
        log.append(Entry("action", step, action_payload(plan)))
    log.append(Entry("edit", 3, edit_payload([Delete(object_id="post")])))
    made = record(Replayer.on(street, ScenarioState.of(street)), log, scene_hash="abc")
    return to_bytes(replace(made, frames={"frames/front/rgb/000002.jpg": b"\xff\xd8 a picture"}))


def mcap_sample(folder: Path) -> list[Parts]:
    from real2sim_server.world.mcap_file import mcap_bytes
    from real2sim_server.world.recording import load_recording

    (folder / "a.r2e").write_bytes(recorded())
    return [{"file": mcap_bytes(load_recording(folder / "a.r2e"))}]


def pickle_sample(folder: Path) -> list[Parts]:
    arrays = {
        0: np.ones((2, 3)),
        "1": np.arange(4, dtype=">i2"),
        np.int64(2): np.zeros((0, 3), "f4"),
    }
    head = io.BytesIO()
    described = {"descr": "|O", "fortran_order": False, "shape": ()}
    np.lib.format.write_array_header_1_0(head, described)
    return [
        {"clouds.npy": head.getvalue() + pickle.dumps(value, protocol=protocol)}
        for protocol in (3, 4, 5)
        for value in (arrays, np.array(arrays, dtype=object))
    ]


def checkpoint_sample(folder: Path) -> list[Parts]:
    state = {"a": torch.ones(2, 3), "b": {"c": [1, 2.5, "x", torch.zeros(3, dtype=torch.int64)]}}
    torch.save(state, folder / "a.pth")
    return [parts_of_zip(folder / "a.pth")]


def old_checkpoint_sample(folder: Path) -> list[Parts]:
    state = {"a": torch.ones(2, 3), "b": [1, 2.5, "x"]}
    torch.save(state, folder / "a.pth", _use_new_zipfile_serialization=False)
    return [{"file": (folder / "a.pth").read_bytes()}]


def images_sample(folder: Path) -> list[Parts]:
    import cv2

    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    return [{"file": cv2.imencode(end, pixels)[1].tobytes()} for end in (".png", ".jpg")]


def npz_sample(folder: Path) -> list[Parts]:
    np.savez(
        folder / "a.npz",
        points=np.ones((4, 3), np.float32),
        intensity=np.ones(4, np.float32),
        offset_us=np.zeros(4, np.int32),
        origin=np.zeros(3, np.float32),
    )
    return [parts_of_zip(folder / "a.npz")]


def proto_sample(folder: Path) -> list[Parts]:
    inner = b"\x09" + np.float64(2.5).tobytes() + b"\x12\x03abc" + b"\x1a\x03\x01\x02\x03"
    return [{"file": b"\x08\x96\x01\x12" + bytes([len(inner)]) + inner + b"\x1d\x00\x00\x80?"}]


def message_sample(folder: Path) -> list[Parts]:
    fields = {"type": "action", "plan": {"times_us": [1, 2], "poses": np.zeros((2, 3))}, "x": None}
    return [{"message.msgpack": encode(fields)}]


def table_sample(suffix: str) -> Callable[[Path], list[Parts]]:
    def sample(folder: Path) -> list[Parts]:
        import pyarrow as pa
        import pyarrow.parquet as pq
        from pyarrow import feather

        table = pa.table({"a": [1, 2, 3], "t": ["x", "y", "z"], "v": [[1.0, 2.0]] * 3})
        path = folder / f"a{suffix}"
        pq.write_table(table, path) if suffix == ".parquet" else feather.write_feather(
            table, path, compression="zstd"
        )
        return [{"file": path.read_bytes()}]

    return sample


# --- reading ----------------------------------------------------------------------------------


def read_splats_as_asset(path: Path) -> None:
    import_splats(path, name="a", as_asset=True, max_bytes=64 * MIB)


def read_bundle(path: Path) -> None:
    for read in (read_scene_summary, load_scene):
        with contextlib.suppress(SceneError):
            read(path)
    loaded = load_scene(path, verify=False)
    loaded.ego.transform(loaded.ego.start_us)


def read_asset_bundle(path: Path) -> None:
    from real2sim_server.scene.io import read_asset_summary

    read_asset_summary(path)
    load_asset(path)


def read_recording(path: Path) -> None:
    from real2sim_server.world.recording import load_recording

    load_recording(path).rescore()


def read_mcap(path: Path) -> None:
    from real2sim_server.world.mcap_file import recording_in

    recording_in(path)


def read_pickle(path: Path) -> None:
    from real2sim_server.logs.readers.street_gaussians import unpack_arrays

    unpack_arrays(str(path), "clouds", str(path.parent))


def read_checkpoint(path: Path) -> None:
    from real2sim_server.reconstruct.imports.checkpoint import unpack_torch_file

    unpack_torch_file(str(path), str(path.parent))


def read_image_file(path: Path) -> None:
    from real2sim_server.logs.images import check_image_file, image_size, read_image

    image_size(path)
    check_image_file(path)
    read_image(path)


def read_sweep(path: Path) -> None:
    from real2sim_server.logs.readers.native import _read_sweep

    _read_sweep(path)


def read_proto(path: Path) -> None:
    from real2sim_server.logs.readers.waymo_v1 import ProtoMessage

    message = ProtoMessage(path.read_bytes(), "file")
    message.integer(1)
    inner = message.message(2, "inner")
    inner.number(1)
    inner.text(2)
    inner.integers(3)
    message.floats(3)


def read_records(path: Path) -> None:
    from real2sim_server.logs.readers.waymo_v1 import list_records, read_record
    from real2sim_server.scene.errors import LeftOut

    for record in list_records(path, LeftOut()):
        read_record(path, record)


def records_sample(folder: Path) -> list[Parts]:
    from real2sim_server.logs.readers.waymo_v1 import masked_crc32c

    whole = b""
    for payload in (b"first", b"", b"third record"):
        length = len(payload).to_bytes(8, "little")
        checks = [masked_crc32c(part).to_bytes(4, "little") for part in (length, payload)]
        whole += length + checks[0] + payload + checks[1]
    return [{"file": whole}]


def read_parquet(path: Path) -> None:
    from real2sim_server.logs.readers.files import ParquetFile

    file = ParquetFile(path)
    file.numbers("a")
    file.texts("t")
    file.lists("v")
    file.cell("v", 0)


def read_feather_file(path: Path) -> None:
    from real2sim_server.logs.readers.files import read_feather

    read_feather(path, ["a", "t"])


def read_message(path: Path) -> None:
    decode(path.read_bytes())


def _message(parts: Parts, folder: Path) -> Path:
    path = folder / "file"
    path.write_bytes(next(iter(parts.values()), b""))
    return path


def _targets() -> list[Target]:
    from real2sim_server.logs import LogError
    from real2sim_server.reconstruct.imports.checkpoint import TorchFileError
    from real2sim_server.scenarios import ScenarioError
    from real2sim_server.world.recording import RecordingError

    scene_errors, log_errors = (SceneError,), (LogError,)
    splat = read_splats_as_asset
    # Read by a process with a memory limit, whose caller converts this into an error.
    confined = (MemoryError,)
    return [
        Target("ply", splats(".ply"), plain(".ply"), splat, scene_errors),
        Target("playcanvas_ply", splats(".compressed.ply"), plain(".ply"), splat, scene_errors),
        Target("spz", splats(".spz"), gzipped(".spz"), splat, scene_errors),
        Target("spz_packed", spz_as_it_is, plain(".spz"), splat, scene_errors),
        Target("spz4", splats(".spz4"), plain(".spz"), splat, scene_errors),
        Target("splat", splats(".splat"), plain(".splat"), splat, scene_errors),
        Target("bundle", bundle_sample, bundle, read_bundle, scene_errors),
        Target("asset", asset_sample, bundle, read_asset_bundle, scene_errors),
        Target("packed", packed_sample, zipped(".zip"), read_packed, scene_errors),
        Target("packed_zip", as_it_is(packed_sample), plain(".zip"), read_packed, scene_errors),
        Target("recording", recording_sample, zipped(".r2e"), read_recording, (RecordingError,)),
        Target(
            "recording_zip",
            as_it_is(recording_sample),
            plain(".r2e"),
            read_recording,
            (RecordingError,),
        ),
        Target("mcap", mcap_sample, plain(".mcap"), read_mcap, (RecordingError,)),
        Target("pickle", pickle_sample, zipped(".npz"), read_pickle, (*confined, LogError)),
        Target(
            "checkpoint",
            checkpoint_sample,
            zipped(".pth"),
            read_checkpoint,
            (*confined, TorchFileError),
        ),
        Target(
            "checkpoint_zip",
            as_it_is(checkpoint_sample),
            plain(".pth"),
            read_checkpoint,
            (*confined, TorchFileError),
        ),
        Target(
            "old_checkpoint",
            old_checkpoint_sample,
            plain(".pth"),
            read_checkpoint,
            (*confined, TorchFileError),
        ),
        Target("image", images_sample, plain(".png"), read_image_file, log_errors),
        Target("sweep", npz_sample, zipped(".npz"), read_sweep, log_errors),
        Target("protobuf", proto_sample, plain(".bin"), read_proto, log_errors),
        Target("tfrecord", records_sample, plain(".tfrecord"), read_records, log_errors),
        Target("parquet", table_sample(".parquet"), plain(".parquet"), read_parquet, log_errors),
        Target(
            "feather", table_sample(".feather"), plain(".feather"), read_feather_file, log_errors
        ),
        Target("message", message_sample, _message, read_message, (CodecError,)),
        Target(
            "sweep_space", sweep_space_sample, plain(".yaml"), read_sweep_space, (CommandError,)
        ),
        Target(
            "openscenario",
            openscenario_sample,
            plain(".xosc"),
            read_scenario_file,
            (ScenarioError,),
        ),
        Target("episode_journal", journal_sample, plain(".journal"), read_journal, (ValueError,)),
        *map_targets(),
    ]


def sweep_space_sample(_folder: Path) -> list[Parts]:
    """A space with each kind of parameter."""
    text = b"""case: {name: c, scene: s, reset: {agents: {drivers: {a: {kind: hard_brake}}}}}
parameters:
  gap: {path: agents.drivers.a.gap, low: 5, high: 20}
  lanes: {kind: int, low: 1, high: 3}
  late: {kind: normal, mean: 1, std: 1, low: 0, high: 2}
  kind: {values: [1, 2]}
  half: {expression: sqrt(gap) / 2}
method: {kind: sobol, count: 8}
"""
    return [{"file": text}]


def read_sweep_space(path: Path) -> Any:
    """Read as at the start of ``real2sim sweep``."""
    from real2sim_server.sweeps import load_sweep

    return load_sweep(path)


def openscenario_sample(_folder: Path) -> list[Parts]:
    """One file for each family of the gallery."""
    from real2sim_server.scenarios.gallery import GALLERY
    from real2sim_server.scenarios.openscenario import write_openscenario

    families = {case.family: case for case in GALLERY.values()}
    return [{"file": write_openscenario(case.storyboard())} for case in families.values()]


def read_scenario_file(path: Path) -> Any:
    """Read as an uploaded file: values come from its parameters."""
    from real2sim_proto.storyboard import resolved
    from real2sim_server.scenarios.openscenario import read_openscenario_text

    return resolved(read_openscenario_text(path.read_bytes(), path.name).board)


def journal_sample(folder: Path) -> list[Parts]:
    """Three rows."""
    from real2sim_server.sweeps.sweep import Journal

    with Journal(folder / "journal") as journal:
        for k in range(3):
            journal.add(f"key{k}", {"x": k / 3, "reason": "horizon"})
    return [{"file": (folder / "journal").read_bytes()}]


def read_journal(path: Path) -> Any:
    """Read as when a sweep resumes."""
    from real2sim_server.sweeps.sweep import Journal

    return Journal(path).rows


def map_targets() -> list[Target]:
    """One target for each map format, with the small valid file of its tests."""
    from real2sim_server.maps import MAP_READERS, MapError, read_map

    place = TESTS / "server/maps/test_other_readers.py"
    spec = importlib.util.spec_from_file_location("written_maps", place)
    assert spec is not None
    assert spec.loader is not None
    written = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(written)

    def target(name: str) -> Target:
        def sample(folder: Path) -> list[Parts]:
            return [{"file": getattr(written, f"written_{name}")(folder).read_bytes()}]

        def write(parts: Parts, folder: Path) -> Path:
            suffix = {"opendrive": "x.xodr", "lanelet2": "x.osm"}.get(
                name, "log_map_archive_x.json"
            )
            path = folder / suffix
            path.write_bytes(parts["file"])
            return path

        def read(path: Path) -> None:
            graph = read_map(path, format=name)
            graph.nearest(0.0, 0.0)
            graph.is_drivable([[0.0, 0.0]])

        return Target(f"map_{name}", sample, write, read, (MapError,))

    return [target(reader.name) for reader in MAP_READERS]


def spz_as_it_is(folder: Path) -> list[Parts]:
    """Files of version 3, with their gzip stream as the part to damage."""
    return [{"file": gzip.compress(p["file"], 9, mtime=0)} for p in splats(".spz")(folder)]


def as_it_is(sample: Callable[[Path], list[Parts]]) -> Callable[[Path], list[Parts]]:
    """The archive itself as the part to damage."""

    def whole(folder: Path) -> list[Parts]:
        return [{"file": zipped(".x")(p, folder).read_bytes()} for p in sample(folder)]

    return whole


def log_target(name: str, drive: Path) -> Target:
    """A log reader for a drive in its layout. ``drive`` is damaged in place."""
    from real2sim_server.logs import LogError, check_log, open_log
    from real2sim_server.logs.check import leave_out

    files = sorted(p for p in drive.rglob("*") if p.is_file())
    valid = {str(p.relative_to(drive)): p.read_bytes() for p in files}

    def write(parts: Parts, folder: Path) -> Path:
        for path, data in valid.items():
            if parts.get(path) != data or not (drive / path).exists():
                (drive / path).write_bytes(parts.get(path, data))
        changed.update(k for k, v in valid.items() if parts.get(k) != v)
        return drive

    def read(path: Path) -> None:
        try:
            log = open_log(path, format=name)
            log = leave_out(log, check_log(log))
            told = {kind: len(sentences) for kind, sentences in log.left_out.items()}
            if "cameras" not in told:
                assert told.get("images", 0) == len(log.absent_images)
            if "LiDARs" not in told:
                assert told.get("sweeps", 0) == len(log.absent_sweeps)
            for frame in range(log.frame_count):
                log.lidar(frame)
                for camera in log.rig.names:
                    if log.has_image(camera, frame):
                        log.image(camera, frame)
        finally:
            for path_of in list(changed):
                (drive / path_of).write_bytes(valid[path_of])
            changed.clear()

    changed: set[str] = set()
    return Target(f"log_{name}", lambda _: [valid], write, read, (LogError,))


def target(name: str, drive: Path | None) -> Target:
    """The target of this name. Log readers use ``drive``."""
    if drive is not None:
        return log_target(name, drive)
    return {t.name: t for t in _targets()}[name]
