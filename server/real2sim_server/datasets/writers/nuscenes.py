"""nuScenes v1.0 with lidarseg and panoptic: key frames at 2 Hz, all other frames as sweeps.

Source: Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", CVPR 2020, and
``docs/schema_nuscenes.md`` of its development kit. A clip is a scene, and the world of the drive is
the frame of the map. ``LIDAR_TOP`` contains the labelled points. Pixel centres are at integers.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import GROUND

from ...geometry import Float, apply_transform, invert_transform, matrix_to_quaternion
from ...render import encode_image
from ...scene import Camera
from ..clips import Clip
from .categories import classes_of
from .writer import LabelledDrive, objects_of, write_json

VERSION = "v1.0-real2sim"
KEY_PERIOD_US = 500_000
QUALITY = 95
LIDAR, FRONT = "LIDAR_TOP", "CAM_FRONT"
OTHER = "static.other"
"""Category of objects that nuScenes has none for. The devkit rejects classes without a colour."""

CLASSES = (
    "noise", "animal", "human.pedestrian.adult", "human.pedestrian.child",
    "human.pedestrian.construction_worker", "human.pedestrian.personal_mobility",
    "human.pedestrian.police_officer", "human.pedestrian.stroller", "human.pedestrian.wheelchair",
    "movable_object.barrier", "movable_object.debris", "movable_object.pushable_pullable",
    "movable_object.trafficcone", "static_object.bicycle_rack", "vehicle.bicycle",
    "vehicle.bus.bendy", "vehicle.bus.rigid", "vehicle.car", "vehicle.construction",
    "vehicle.emergency.ambulance", "vehicle.emergency.police", "vehicle.motorcycle",
    "vehicle.trailer", "vehicle.truck", "flat.driveable_surface", "flat.other", "flat.sidewalk",
    "flat.terrain", "static.manmade", "static.other", "static.vegetation", "vehicle.ego",
)  # fmt: skip
"""The categories of nuScenes-lidarseg in the order of their indices."""

LEVELS = ("v0-40", "v40-60", "v60-80", "v80-100")
BOUNDS = (0.4, 0.6, 0.8)
DRIVEABLE, MANMADE = "flat.driveable_surface", "static.manmade"
PANOPTIC = 1000
"""Factor of the category index in a panoptic label; the object's number is added."""
SPEED_MOVING = 0.2
MAP_CELL = 0.1
"""Cell of the ground mask, as in the development kit [m]."""
MAX_MAP = 4096


class NuScenesWriter:
    """Writes ``samples``, ``sweeps``, ``maps`` and the tables."""

    name = "nuscenes"
    holds = "v1.0 tables, samples and sweeps of cameras and LIDAR_TOP, a mask of the ground as map"

    def write(self, drive: LabelledDrive, folder: Path) -> None:
        """See :class:`DatasetWriter`. Raises OSError."""
        tables = _Tables(drive)
        tables.add_sensors()
        tables.add_categories()
        for clip in drive.clips:
            tables.add_clip(clip, folder)
        tables.add_map(folder)
        for name, rows in tables.rows.items():
            write_json(folder / VERSION / f"{name}.json", rows)
        splits: dict[str, list[str]] = {}
        for clip in drive.clips:
            splits.setdefault(clip.split, []).append(_scene_name(clip))
        write_json(folder / "splits.json", splits)


def _scene_name(clip: Clip) -> str:
    return f"scene-{clip.name}"


def channels_of(cameras: Sequence[Camera]) -> dict[str, str]:
    """Channel of each camera by its name: the most forward-looking one is CAM_FRONT."""
    ahead = max(cameras, key=lambda c: float(c.T_vehicle_camera[0, 2]))
    names = {c.name: f"CAM_{c.name.upper().removeprefix('CAM_')}" for c in cameras}
    for name, channel in names.items():
        if channel == FRONT and name != ahead.name:
            names[name] = f"{FRONT}_{name.upper()}"
    names[ahead.name] = FRONT
    return names


class _Tables:
    """Rows of all tables, in insertion order."""

    def __init__(self, drive: LabelledDrive) -> None:
        self.drive = drive
        self.channels = channels_of(drive.cameras)
        self.rows: dict[str, list[dict[str, Any]]] = {
            name: []
            for name in (
                "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "lidarseg",
                "log", "map", "panoptic", "sample", "sample_annotation", "sample_data", "scene",
                "sensor", "visibility",
            )
        }  # fmt: skip

    def add(self, table: str, key: tuple[object, ...], **fields: Any) -> str:
        token = self.drive.token(table, *key)
        self.rows[table].append({"token": token, **fields})
        return token

    def add_sensors(self) -> None:
        self._sensor(LIDAR, "lidar", _shift(self.drive.lidar_position), [])
        for camera in self.drive.cameras:
            K = camera.K.copy()
            K[:2, 2] -= 0.5
            channel = self.channels[camera.name]
            self._sensor(channel, "camera", camera.T_vehicle_camera, K.tolist())

    def _sensor(self, channel: str, modality: str, mount: Float, K: list[list[float]]) -> None:
        sensor = self.add("sensor", (channel,), channel=channel, modality=modality)
        self.add(
            "calibrated_sensor", (channel,), sensor_token=sensor, **_pose(mount), camera_intrinsic=K
        )

    def add_categories(self) -> None:
        for index, name in enumerate(CLASSES):
            self.add("category", (name,), name=name, description="", index=index)
        for level, name in enumerate(LEVELS, start=1):
            share = name.removeprefix("v")
            self.rows["visibility"].append(
                {"token": str(level), "level": name, "description": f"{share} % of it is seen"}
            )
        for name in ("vehicle.moving", "vehicle.parked"):
            self.add("attribute", (name,), name=name, description="")

    def add_map(self, folder: Path) -> None:
        ground = self.drive.ground
        factor = round(ground.cell / MAP_CELL)
        known = np.repeat(np.repeat(ground.is_ground, factor, axis=0), factor, axis=1)
        # Image rows run from north to south.
        picture = np.ascontiguousarray(known[:MAX_MAP, :MAX_MAP].T[::-1].astype(np.uint8) * 255)
        token = self.drive.token("map")
        path = folder / "maps" / f"{token}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_image(picture, "semantic", "png").data)
        logs = [row["token"] for row in self.rows["log"]]
        self.rows["map"].append(
            {
                "token": token,
                "category": "semantic_prior",
                "filename": f"maps/{token}.png",
                "log_tokens": logs,
            }
        )

    def add_clip(self, clip: Clip, folder: Path) -> None:
        log = self.add(
            "log",
            (clip.name,),
            logfile=f"{self.drive.name}-{clip.name}",
            vehicle=self.drive.name,
            date_captured="1970-01-01",
            location=self.drive.name,
        )
        keys = _key_frames(clip)
        samples = self._samples(clip, keys)
        self.add(
            "scene",
            (clip.name,),
            log_token=log,
            nbr_samples=len(keys),
            first_sample_token=samples[0],
            last_sample_token=samples[-1],
            name=_scene_name(clip),
            description=clip.split,
        )
        self._sample_data(clip, keys, samples, folder)
        self._annotations(clip, keys, samples)

    def _samples(self, clip: Clip, keys: Sequence[int]) -> list[str]:
        tokens = [self.drive.token("sample", clip.name, k) for k in keys]
        for place, (token, k) in enumerate(zip(tokens, keys, strict=True)):
            self.rows["sample"].append(
                {
                    "token": token,
                    "timestamp": clip.frames[k]["t_us"],
                    "prev": tokens[place - 1] if place else "",
                    "next": tokens[place + 1] if place + 1 < len(tokens) else "",
                    "scene_token": self.drive.token("scene", clip.name),
                }
            )
        return tokens

    def _sample_data(
        self, clip: Clip, keys: Sequence[int], samples: Sequence[str], folder: Path
    ) -> None:
        for frame in clip.frames:
            pose = np.array(frame["T_world_ego"])
            self.add(
                "ego_pose", (clip.name, frame["index"]), timestamp=frame["t_us"], **_pose(pose)
            )
        cameras = {self.channels[camera.name]: camera for camera in self.drive.cameras}
        for channel in (LIDAR, *cameras):
            tokens = [
                self.drive.token("sample_data", clip.name, channel, f["index"]) for f in clip.frames
            ]
            for k, frame in enumerate(clip.frames):
                sample = max(place for place, key in enumerate(keys) if key <= k)
                is_key = keys[sample] == k
                camera = cameras.get(channel)
                name = _file_name(clip, channel, frame, is_key=is_key)
                path = folder / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(self._scan(clip, k) if camera is None else _image(clip, camera, k))
                self.rows["sample_data"].append(
                    {
                        "token": tokens[k],
                        "sample_token": samples[sample],
                        "ego_pose_token": self.drive.token("ego_pose", clip.name, frame["index"]),
                        "calibrated_sensor_token": self.drive.token("calibrated_sensor", channel),
                        "filename": name,
                        "fileformat": "pcd" if camera is None else "jpg",
                        "width": 0 if camera is None else camera.width,
                        "height": 0 if camera is None else camera.height,
                        "timestamp": frame["t_us"],
                        "is_key_frame": is_key,
                        "next": tokens[k + 1] if k + 1 < len(tokens) else "",
                        "prev": tokens[k - 1] if k else "",
                    }
                )
                if is_key and camera is None:
                    self._point_labels(clip, k, tokens[k], folder)

    def _scan(self, clip: Clip, frame: int) -> bytes:
        """x, y, z, intensity (0 to 255) and row of each point in the scanner's frame, float32."""
        rows = clip.points(frame)
        scan = np.empty((len(rows), 5), "<f4")
        to_lidar = invert_transform(_shift(self.drive.lidar_position))
        scan[:, :3] = apply_transform(to_lidar, rows["xyz"].astype(np.float64))
        scan[:, 3], scan[:, 4] = rows["intensity"] * 255, rows["beam"]
        return scan.tobytes()

    def _point_labels(self, clip: Clip, frame: int, sample_data: str, folder: Path) -> None:
        """Classes and objects of the points of a key frame: lidarseg and panoptic."""
        rows = clip.points(frame)
        classes = np.where(
            rows["semantic"] == GROUND, CLASSES.index(DRIVEABLE), CLASSES.index(MANMADE)
        )
        for subject in clip.frames[frame]["objects"]:
            own = rows["instance"] == subject["instance_id"]
            classes[own] = CLASSES.index(_category(subject["category"]))
        things = rows["instance"].astype(np.int64) % PANOPTIC
        files = {
            "lidarseg": ("_lidarseg.bin", classes.astype(np.uint8).tobytes()),
            "panoptic": ("_panoptic.npz", _npz((classes * PANOPTIC + things).astype(np.uint16))),
        }
        for table, (suffix, data) in files.items():
            name = f"{table}/{VERSION}/{sample_data}{suffix}"
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            self.rows[table].append(
                {"token": sample_data, "sample_data_token": sample_data, "filename": name}
            )

    def _annotations(self, clip: Clip, keys: Sequence[int], samples: Sequence[str]) -> None:
        seen: dict[str, list[tuple[int, str]]] = {}
        for k, sample in zip(keys, samples, strict=True):
            for object_id in objects_of(clip.frames[k]):
                seen.setdefault(object_id, []).append((k, sample))
        for object_id, places in seen.items():
            tokens = [self._annotation_token(clip, object_id, k) for k, _ in places]
            category = objects_of(clip.frames[places[0][0]])[object_id]["category"]
            self.add(
                "instance",
                (clip.name, object_id),
                category_token=self.drive.token("category", _category(category)),
                nbr_annotations=len(places),
                first_annotation_token=tokens[0],
                last_annotation_token=tokens[-1],
            )
            for place, (k, sample) in enumerate(places):
                row = self._annotation(clip.frames[k], object_id)
                row |= {
                    "token": tokens[place],
                    "sample_token": sample,
                    "instance_token": self.drive.token("instance", clip.name, object_id),
                    "prev": tokens[place - 1] if place else "",
                    "next": tokens[place + 1] if place + 1 < len(tokens) else "",
                }
                self.rows["sample_annotation"].append(row)

    def _annotation_token(self, clip: Clip, object_id: str, frame: int) -> str:
        return self.drive.token("sample_annotation", clip.name, object_id, frame)

    def _annotation(self, frame: Mapping[str, Any], object_id: str) -> dict[str, Any]:
        subject = objects_of(frame)[object_id]
        length, width, height = subject["size"]
        views = [v for rows in frame["views"].values() for v in rows if v["object_id"] == object_id]
        visibility = max((v["visibility"] for v in views), default=0.0)
        moving = float(np.linalg.norm(subject["velocity"])) > SPEED_MOVING
        attribute = "vehicle.moving" if moving else "vehicle.parked"
        vehicle = _category(subject["category"]).startswith("vehicle.")
        return {
            "visibility_token": str(1 + sum(visibility >= bound for bound in BOUNDS)),
            "attribute_tokens": [self.drive.token("attribute", attribute)] if vehicle else [],
            **_pose(np.array(subject["T_world_object"])),
            "size": [width, length, height],
            "num_lidar_pts": subject["points"],
            "num_radar_pts": 0,
        }


def _npz(labels: NDArray[np.uint16]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, data=labels)
    return file.getvalue()


def _category(category: str) -> str:
    return classes_of(category).nuscenes or OTHER


def _key_frames(clip: Clip) -> list[int]:
    """The first frame, and every frame at least half a second after the previous key frame."""
    keys = [0]
    for k, frame in enumerate(clip.frames):
        if frame["t_us"] - clip.frames[keys[-1]]["t_us"] >= KEY_PERIOD_US:
            keys.append(k)
    return keys


def _file_name(clip: Clip, channel: str, frame: Mapping[str, Any], *, is_key: bool) -> str:
    suffix = "pcd.bin" if channel == LIDAR else "jpg"
    folder = "samples" if is_key else "sweeps"
    return f"{folder}/{channel}/{clip.name}__{channel}__{frame['t_us']}.{suffix}"


def _image(clip: Clip, camera: Camera, frame: int) -> bytes:
    rgb = clip.pixels("rgb", camera.name, frame)
    return encode_image(rgb, "rgb", "jpeg", quality=QUALITY).data


def _pose(transform: Float) -> dict[str, list[float]]:
    quaternion = matrix_to_quaternion(transform[:3, :3])
    return {"translation": transform[:3, 3].tolist(), "rotation": quaternion.tolist()}


def _shift(position: Sequence[float]) -> Float:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return matrix
