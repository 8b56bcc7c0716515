"""Logs with damaged records: the rest is read, and all that is left out is told.

Each layout lists its records of every kind and how to damage each. Damaging some must cost exactly
these: images, sweeps, boxes, frames and cameras that were read, and those told as left out, add up
to what the files held.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pyarrow import feather

from real2sim_server.logs import DrivingLog, open_log
from real2sim_server.logs.readers.waymo_v1 import ProtoMessage, _split, list_records, read_record
from real2sim_server.scene.errors import LeftOut
from real2sim_server.synthetic import SyntheticConfig, generate_log

from .conftest import _layout, write_layout

FRAMES = 12
SMALL = SyntheticConfig(seed=5, frames=FRAMES, width=48, height=32, moving_cars=3, parked_cars=4,
                        lidar_beams=8, lidar_columns=90)  # fmt: skip
LAYOUTS = ("native", "kitti", "kitti_raw", "waymo_v2", "waymo_v1", "argoverse2", "nuscenes",
           "street_gaussians", "drivestudio")  # fmt: skip
POSES = "ego_pose"


@dataclass(frozen=True)
class Damage:
    """How to damage one record of a kind, and what that costs."""

    kind: str
    apply: Callable[[], object]
    images: frozenset[tuple[str, int]] = frozenset()
    sweeps: frozenset[int] = frozenset()
    boxes: frozenset[tuple[str, int]] = frozenset()
    frames: frozenset[int] = frozenset()
    cameras: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Read:
    """A log as it was read: images, sweeps and boxes by their times."""

    log: DrivingLog
    boxes: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path) -> Read:
        log = open_log(folder)
        keys = log.provenance.get("track_ids", {})
        boxes = {
            (keys.get(track.object_id, track.object_id), t_us): track.trajectory.transform(t_us)
            for track in log.tracks
            for t_us in track.trajectory.times_us.tolist()
        }
        return cls(log, boxes)


@pytest.fixture(scope="session")
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A function that gives the folder of a whole drive in a layout, and what is read of it."""
    log, known = generate_log(SMALL), {}

    def written(name: str) -> tuple[Path, Read]:
        if name not in known:
            folder = write_layout(name, log, tmp_path_factory.mktemp(f"whole_{name}"))
            known[name] = folder, Read.of(folder)
        return known[name]

    return written


@pytest.mark.parametrize("kind", ["image", "sweep", "pose", "box", "calibration"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_damaged_record_costs_only_itself(
    drive: Any, tmp_path: Path, layout: str, kind: str
) -> None:
    whole, base = drive(layout)
    folder = Path(shutil.copytree(whole, tmp_path / whole.name))
    of_kind = [d for d in damages(layout, folder, base) if d.kind == kind]
    chosen = of_kind[len(of_kind) // 2]
    chosen.apply()
    compare(base, Read.of(folder), [chosen])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("layout", LAYOUTS)
def test_twenty_damaged_records_cost_only_themselves(
    drive: Any, tmp_path: Path, layout: str, seed: int
) -> None:
    whole, base = drive(layout)
    folder = Path(shutil.copytree(whole, tmp_path / whole.name))
    known = list(damages(layout, folder, base))
    chosen = [known[i] for i in np.random.default_rng(seed).permutation(len(known))[:20]]
    for damage in chosen:
        damage.apply()
    compare(base, Read.of(folder), chosen)


@pytest.mark.parametrize("copies", [20, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("layout", "table"),
    [("kitti", "training/label_02/0007.txt"), ("street_gaussians", "track/track_info.txt")],
)
def test_boxes_of_a_damaged_table_add_up(
    drive: Any, tmp_path: Path, layout: str, table: str, copies: int
) -> None:
    whole, _ = drive(layout)
    folder = Path(shutil.copytree(whole, tmp_path / whole.name))
    lines = (folder / table).read_text().splitlines()
    for seed in range(copies):
        given = damaged_lines(lines, np.random.default_rng(seed))
        (folder / table).write_text("\n".join(given), encoding="utf-8")
        rows = [line.split() for line in (given if layout == "kitti" else given[1:])]
        held = sum(bool(row) and row[2:3] != ["DontCare"] for row in rows)
        log = open_log(folder)
        read = sum(len(track.trajectory.times_us) for track in log.tracks)
        assert read + len(log.left_out.get("boxes", ())) == held, f"seed {seed}"


def damaged_lines(lines: list[str], rng: np.random.Generator) -> list[str]:
    """Lines of which some are dropped, doubled, cut, blank or have other characters or columns."""
    found = list(lines)
    for _ in range(rng.integers(1, 6)):
        i = int(rng.integers(1, len(found)))
        line = found[i]
        at = int(rng.integers(0, max(len(line), 1)))
        character = "0123456789.-e \t,nanx\u00e9"[rng.integers(0, 20)]
        found[i : i + 1] = [
            [],
            [line, line],
            [line[:at]],
            [""],
            [line[:at] + character + line[at + 1 :]],
            [f"{line} {line}"],
        ][rng.integers(0, 6)]
    return found


def compare(base: Read, read: Read, chosen: Iterable[Damage]) -> None:
    lost = {
        name: frozenset().union(*(getattr(d, name) for d in chosen))
        for name in ("images", "sweeps", "boxes", "frames", "cameras")
    }
    old, new = base.log, read.log
    told = {k: len(t) - len(old.left_out.get(k, ())) for k, t in new.left_out.items()}
    moved = any(d.kind == "pose" for d in chosen)  # poses beside a lost one are interpolated
    kept = [f for f in range(old.frame_count) if f not in lost["frames"]]
    assert new.frame_times_us.tolist() == old.frame_times_us[kept].tolist()
    assert told.get("frames", 0) == len(lost["frames"])
    assert list(new.rig.names) == [n for n in old.rig.names if n not in lost["cameras"]]
    assert told.get("cameras", 0) == len(lost["cameras"])
    images = sweeps = 0
    for ours, frame in enumerate(kept):
        for name in new.rig.names:
            assert new.has_image(name, ours) == ((name, frame) not in lost["images"])
            if new.has_image(name, ours):
                assert (new.image(name, ours) == old.image(name, frame)).all()
            else:
                images += 1
        assert (ours in new.absent_sweeps) == (frame in lost["sweeps"])
        if ours in new.absent_sweeps:
            sweeps += 1
            assert len(new.lidar(ours).points) == 0
        else:
            points = old.lidar(frame).points
            assert len(points) > 100
            np.testing.assert_allclose(new.lidar(ours).points, points, atol=0.5 if moved else 1e-6)
    assert told.get("images", 0) == images
    assert told.get("sweeps", 0) == sweeps
    times = {int(old.frame_times_us[f]) for f in lost["frames"]}
    outside = {key for key in base.boxes if key[1] in times}
    expected = base.boxes.keys() - lost["boxes"] - outside
    assert expected <= read.boxes.keys() <= expected | outside
    for key in expected:
        atol = 0.3 if moved else 1e-6
        np.testing.assert_allclose(read.boxes[key], base.boxes[key], atol=atol)
    unread = len(base.boxes) - len(read.boxes) - told.get("boxes", 0)
    assert 0 <= unread <= len(outside)


# --- Records of the layouts ----------------------------------------------------------------------


def damages(layout: str, folder: Path, base: Read) -> Iterator[Damage]:
    """Damage of each record; the poses at the ends are left alone, because they give the world."""
    yield from globals()[f"_{layout}"](folder, base)


def _cut(path: Path) -> Callable[[], object]:
    return lambda: path.write_bytes(path.read_bytes()[: path.stat().st_size // 3 * 2 - 1])


def _file(kind: str, path: Path, **costs: Any) -> Damage:
    """Remove a file with an even number in its path, and cut off others."""
    assert path.is_file(), path
    number = sum(int(c) for c in path.stem if c.isdecimal())
    return Damage(kind, path.unlink if number % 2 else _cut(path), **costs)


def _images(base: Read, path: Callable[[str, int], Path]) -> Iterator[Damage]:
    for name in base.log.rig.names:
        for frame in range(FRAMES):
            yield _file("image", path(name, frame), images=frozenset({(name, frame)}))


def _sweeps(path: Callable[[int], Path]) -> Iterator[Damage]:
    for frame in range(FRAMES):
        yield _file("sweep", path(frame), sweeps=frozenset({frame}))


def _json(path: Path, edit: Callable[[Any], object]) -> Callable[[], None]:
    def change() -> None:
        content = json.loads(path.read_text())
        edit(content)
        path.write_text(json.dumps(content))

    return change


def _line(path: Path, number: int, text: str) -> Callable[[], None]:
    def change() -> None:
        lines = path.read_text().split("\n")
        lines[number] = text
        path.write_text("\n".join(lines))

    return change


def _box(base: Read, key: str, time_us: int) -> dict[str, Any]:
    assert (key, time_us) in base.boxes
    return {"boxes": frozenset({(key, time_us)})}


def _camera(name: str) -> dict[str, Any]:
    return {"cameras": frozenset({name})}


def _native(folder: Path, base: Read) -> Iterator[Damage]:
    manifest = folder / "log.json"
    content = json.loads(manifest.read_text())
    yield from _images(base, lambda name, f: folder / f"images/{name}/{f:06d}.png")
    yield from _sweeps(lambda f: folder / f"lidar/{f:06d}.npz")
    for i in range(1, FRAMES - 1):
        yield Damage(
            "pose", _json(manifest, lambda c, i=i: c["ego"]["positions"][i].__setitem__(0, np.nan))
        )
    for k, track in enumerate(content["tracks"]):
        for i, t_us in enumerate(track["times_us"][1:], start=1):
            edit = _json(
                manifest,
                lambda c, k=k, i=i: c["tracks"][k]["quaternions"][i].__setitem__(0, 7.0),
            )
            yield Damage("box", edit, **_box(base, track["object_id"], t_us))
    yield Damage(
        "calibration",
        _json(manifest, lambda c: c["cameras"][1].pop("K")),
        **_camera(base.log.rig.names[1]),
    )


def _kitti(folder: Path, base: Read) -> Iterator[Damage]:
    root = folder / "training"
    yield from _images(base, lambda name, f: root / f"{name}/0007/{f:06d}.png")
    yield from _sweeps(lambda f: root / f"velodyne/0007/{f:06d}.bin")
    for f in range(1, FRAMES - 1):
        edit = _line(root / "poses/0007.txt", f, "1 0 0 nan")
        yield Damage("pose", edit, frames=frozenset({f}))
    labels = root / "label_02/0007.txt"
    for i, line in enumerate(labels.read_text().splitlines()):
        frame, number, kind = line.split()[:3]
        if kind != "DontCare":
            time_us = int(base.log.frame_times_us[int(frame)])
            edit = _line(labels, i, " ".join(line.split()[:9]))
            yield Damage("box", edit, **_box(base, f"{kind.lower()}_{number}", time_us))
    yield Damage("calibration", _line(root / "calib/0007.txt", 1, "P2: 1 x"), **_camera("image_02"))


def _kitti_raw(folder: Path, base: Read) -> Iterator[Damage]:
    day = next(folder.glob("2011*"))
    drive = next(day.glob("*_sync"))
    yield from _images(base, lambda name, f: drive / f"{name}/data/{f:010d}.png")
    yield from _sweeps(lambda f: drive / f"velodyne_points/data/{f:010d}.bin")
    for f in range(1, FRAMES - 1):
        yield _file("pose", drive / f"oxts/data/{f:010d}.txt", frames=frozenset({f}))
    tracklets = drive / "tracklet_labels.xml"
    for number in range(tracklets.read_text().count("<objectType>")):
        for f in range(FRAMES):

            def edit(number: int = number, f: int = f) -> None:
                items = tracklets.read_text().split("<objectType>")
                poses = items[number + 1].split("<tx>")
                poses[f + 1] = "nan" + poses[f + 1]
                items[number + 1] = "<tx>".join(poses)
                tracklets.write_text("<objectType>".join(items))

            yield Damage("box", edit, **_box(base, str(number), int(base.log.frame_times_us[f])))
    edit = _line(day / "calib_cam_to_cam.txt", 4, "P_rect_02: 1 x")
    yield Damage("calibration", edit, **_camera("image_02"))


def _table(path: Path, edit: Callable[[list[dict]], object]) -> Callable[[], None]:
    """Edit the rows of a Feather or Parquet file."""
    is_feather = path.suffix == ".feather"

    def change() -> None:
        table = feather.read_table(path) if is_feather else pq.read_table(path)
        rows = table.to_pylist()
        edit(rows)
        changed = pa.Table.from_pylist(rows, schema=table.schema)
        feather.write_feather(changed, str(path)) if is_feather else pq.write_table(changed, path)

    return change


def _remove_row(match: dict[str, Any]) -> Callable[[list[dict]], None]:
    def edit(rows: list[dict]) -> None:
        (row,) = [r for r in rows if all(r[k] == v for k, v in match.items())]
        rows.remove(row)

    return edit


def _set_row(match: dict[str, Any], **values: Any) -> Callable[[list[dict]], None]:
    def edit(rows: list[dict]) -> None:
        (row,) = [r for r in rows if all(r[k] == v for k, v in match.items())]
        row.update(values)

    return edit


def _waymo_v2(folder: Path, base: Read) -> Iterator[Damage]:
    from real2sim_server.logs.readers.waymo_common import CAMERA_NAMES
    from real2sim_server.logs.readers.waymo_v2 import (
        BOX,
        CALIBRATION,
        CAMERA,
        IMAGE,
        OBJECT,
        POSE,
        TIME,
    )  # fmt: skip

    def file(component: str) -> Path:
        return next((folder / component).glob("*.parquet"))

    starts = (base.log.frame_times_us - 50_000).tolist()
    numbers = {name: number for number, name in CAMERA_NAMES.items()}
    for name in base.log.rig.names:
        for f, start in enumerate(starts):
            row = {TIME: start, CAMERA: numbers[name]}
            broken = _set_row(row, **{f"{IMAGE}.image": b"\x89PNG"})
            # The front camera's images give the frames their times.
            edit = broken if f % 2 or name == "front" else _remove_row(row)
            yield Damage("image", _table(file("camera_image"), edit), images=frozenset({(name, f)}))
    for f, start in enumerate(starts):
        edit = _table(file("lidar"), _remove_row({TIME: start}))
        yield Damage("sweep", edit, sweeps=frozenset({f}))
        if 0 < f < FRAMES - 1:
            edit = _table(file("vehicle_pose"), _set_row({TIME: start}, **{POSE: None}))
            yield Damage("pose", edit, frames=frozenset({f}))
    for row in pq.read_table(file("lidar_box")).to_pylist():
        match = {TIME: row[TIME], OBJECT: row[OBJECT]}
        edit = _table(file("lidar_box"), _set_row(match, **{f"{BOX}.box.size.x": 0.0}))
        yield Damage("box", edit, **_box(base, row[OBJECT], row[TIME] + 50_000))
    edit = _set_row({CAMERA: 2}, **{f"{CALIBRATION}.intrinsic.f_u": None})
    yield Damage("calibration", _table(file("camera_calibration"), edit), **_camera("front_left"))


def _waymo_v1(folder: Path, base: Read) -> Iterator[Damage]:
    path, layout = folder / "tiny.tfrecord", _layout("waymo_v1")

    def edit_frame(frame: int, edit: Callable[[list[tuple[int, Any]]], None]) -> Callable[[], None]:
        def change() -> None:
            payloads = [read_record(path, r) for r in list_records(path, LeftOut())]
            fields = list(_split(payloads[frame]))
            edit(fields)
            payloads[frame] = b"".join(
                layout._blob(n, v) if isinstance(v, bytes) else layout._varint_field(n, v)
                for n, v in fields
            )
            layout.write_payloads(payloads, path)

        return change

    def drop(number: int, is_it: Callable[[ProtoMessage], bool]) -> Callable[[list], None]:
        def edit(fields: list[tuple[int, Any]]) -> None:
            (field,) = [
                (n, v) for n, v in fields if n == number and is_it(ProtoMessage(v, "field"))
            ]
            fields.remove(field)

        return edit

    for name, number in layout.NUMBERS.items():
        for f in range(FRAMES):
            if name != "front":
                edit = edit_frame(f, drop(4, lambda m, number=number: m.integer(1) == number))
                yield Damage("image", edit, images=frozenset({(name, f)}))
    for f in range(FRAMES):
        edit = edit_frame(f, drop(5, lambda m: True))
        yield Damage("sweep", edit, sweeps=frozenset({f}))
        if 0 < f < FRAMES - 1:
            edit = edit_frame(f, drop(3, lambda m: True))
            yield Damage("pose", edit, frames=frozenset({f}))
    for key, t_us in base.boxes:
        f = base.log.frame_times_us.tolist().index(t_us)

        def flatten(fields: list[tuple[int, Any]], key: str = key) -> None:
            for i, (n, value) in enumerate(fields):
                if n == 6 and ProtoMessage(value, "label").text(4) == key:
                    fields[i] = n, value + layout._blob(1, layout._double(5, 0.0))

        yield Damage("box", edit_frame(f, flatten), **_box(base, key, t_us))

    def spoil(fields: list[tuple[int, Any]]) -> None:
        context = list(_split(fields[0][1]))
        n, camera = [(n, v) for n, v in context if n == 2][1]
        place = context.index((n, camera))
        context[place] = n, layout._varint_field(1, 2)
        fields[0] = 1, b"".join(layout._blob(n, v) for n, v in context)

    yield Damage("calibration", edit_frame(0, spoil), **_camera("front_left"))


def _argoverse2(folder: Path, base: Read) -> Iterator[Damage]:
    stamps = sorted(int(p.stem) for p in (folder / "sensors/lidar").iterdir())
    yield from _images(base, lambda name, f: folder / f"sensors/cameras/{name}/{stamps[f]}.jpg")
    for f in range(1, FRAMES - 1):
        path = folder / f"sensors/lidar/{stamps[f]}.feather"
        if f % 3 == 0:
            yield Damage("sweep", path.unlink, frames=frozenset({f}))
        else:
            yield Damage("sweep", _cut(path), sweeps=frozenset({f}))
        match = {"timestamp_ns": stamps[f]}
        poses = folder / "city_SE3_egovehicle.feather"
        yield Damage("pose", _table(poses, _set_row(match, tx_m=float("nan"))))
    boxes = folder / "annotations.feather"
    for row in feather.read_table(boxes).to_pylist():
        match = {k: row[k] for k in ("timestamp_ns", "track_uuid")}
        edit = _table(boxes, _set_row(match, qw=None))
        yield Damage("box", edit, **_box(base, row["track_uuid"], row["timestamp_ns"] // 1000))
    edit = _set_row({"sensor_name": "ring_front_left"}, fx_px=0.0)
    path = folder / "calibration/intrinsics.feather"
    yield Damage("calibration", _table(path, edit), **_camera("ring_front_left"))


def _nuscenes(folder: Path, base: Read) -> Iterator[Damage]:
    tables = folder / "v1.0-mini"

    def rows(table: str, edit: Callable[[list[dict]], object]) -> Callable[[], None]:
        return _json(tables / f"{table}.json", edit)

    for name in base.log.rig.names:
        channel = name.upper()
        for f in range(FRAMES):
            costs = {"images": frozenset({(name, f)})}
            if f % 2 and 0 < f < FRAMES - 1:
                edit = _remove_row({"token": f"d{f}_{channel}"})
                yield Damage("image", rows("sample_data", edit), **costs)
            else:
                yield _file(
                    "image", folder / f"samples/{channel}/n008__{channel}__{f}.jpg", **costs
                )
    yield from _sweeps(lambda f: folder / f"sweeps/LIDAR_TOP/n008__LIDAR_TOP__{f}.pcd.bin")
    for f in range(1, FRAMES - 1):
        yield Damage("pose", rows("ego_pose", _remove_row({"token": f"e_{f}_LIDAR_TOP"})))
    for row in json.loads((tables / "sample_annotation.json").read_text()):
        frame = int(row["sample_token"][1:])
        edit = rows("sample_annotation", _set_row({"token": row["token"]}, instance_token="none"))
        time_us = int(base.log.frame_times_us[frame])
        yield Damage("box", edit, **_box(base, row["instance_token"], time_us))
    edit = _set_row({"token": "cs_CAM_FRONT_LEFT"}, camera_intrinsic=[])
    yield Damage("calibration", rows("calibrated_sensor", edit), **_camera("cam_front_left"))


def _street_gaussians(folder: Path, base: Read) -> Iterator[Damage]:
    yield from _images(
        base, lambda name, f: folder / f"images/{f:06d}_{base.log.rig.names.index(name)}.png"
    )
    for f in range(FRAMES):

        def edit(f: int = f) -> None:
            with np.load(folder / "pointcloud.npz", allow_pickle=True) as parts:
                arrays = {name: parts[name].item() for name in parts}
            arrays["pointcloud"].pop(f)
            np.savez(folder / "pointcloud.npz", **arrays)

        yield Damage("sweep", edit, sweeps=frozenset({f}))
    for f in range(1, FRAMES - 1):
        path = folder / f"ego_pose/{f:06d}.txt"
        yield Damage("pose", _line(path, 2, "0 0"), frames=frozenset({f}))
    tracks = folder / "track/track_info.txt"
    for i, line in enumerate(tracks.read_text().splitlines()[1:], start=1):
        frame, key, *rest = line.split()
        edit = _line(tracks, i, " ".join([frame, key, *rest[:5]]))
        yield Damage("box", edit, **_box(base, key, int(base.log.frame_times_us[int(frame)])))
    edit = (folder / "extrinsics/1.txt").unlink
    yield Damage("calibration", edit, **_camera(base.log.rig.names[1]))


def _drivestudio(folder: Path, base: Read) -> Iterator[Damage]:
    yield from _images(
        base, lambda name, f: folder / f"images/{f:03d}_{base.log.rig.names.index(name)}.jpg"
    )
    yield from _sweeps(lambda f: folder / f"lidar/{f:03d}.bin")
    for f in range(1, FRAMES - 1):
        yield _file("pose", folder / f"ego_pose/{f:03d}.txt", frames=frozenset({f}))
    instances = folder / "instances/instances_info.json"
    for key in json.loads(instances.read_text()):
        for f, t_us in enumerate(base.log.frame_times_us.tolist()):
            edit = _json(
                instances,
                lambda c, key=key, f=f: c[key]["frame_annotations"]["obj_to_world"][f][
                    0
                ].__setitem__(0, 9.0),
            )
            yield Damage("box", edit, **_box(base, key, t_us))
    edit = _line(folder / "intrinsics/1.txt", 0, "zero")
    yield Damage("calibration", edit, **_camera(base.log.rig.names[1]))
