"""Small checkpoints and dataset folders in the formats of other systems."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch


def pose(x: float, y: float, z: float, yaw: float) -> np.ndarray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=float)


def write_matrix(file: Path, values: Any) -> None:
    """Write a matrix as text, one row per line."""
    rows = np.atleast_2d(np.asarray(values, dtype=float)).tolist()
    file.write_text("\n".join(" ".join(map(repr, row)) for row in rows) + "\n")


def street_model(count: int, *, harmonics: int = 3, fourier: int = 1, seed: int = 0) -> dict:
    """One model of a Street Gaussians checkpoint."""
    random = torch.Generator().manual_seed(seed)

    def values(*shape: int) -> torch.nn.Parameter:
        return torch.nn.Parameter(torch.randn(*shape, generator=random))

    return {
        "xyz": values(count, 3),
        "feature_dc": values(count, fourier, 3),
        "feature_rest": values(count, harmonics, 3),
        "scaling": values(count, 3),
        "rotation": values(count, 4),
        "opacity": values(count, 1),
        "semantic": torch.zeros(count, 0),
    }


def opengl_direction(face: int, x: float, y: float) -> np.ndarray:
    """View direction of a face pixel at (x right, y down) in [-1, 1], as in ``cube_to_dir``."""
    direction = [
        (1, -y, -x),
        (-1, -y, x),
        (x, 1, y),
        (x, -1, -y),
        (x, -y, 1),
        (-x, -y, -1),
    ][face]
    return np.array(direction) / np.linalg.norm(direction)


def direction_cube(resolution: int) -> torch.Tensor:
    """A cube map [6, R, R, 3] with colours (direction + 1) / 2."""
    faces = np.zeros((6, resolution, resolution, 3), dtype=np.float32)
    for face, row, column in np.ndindex(6, resolution, resolution):
        x, y = ((c + 0.5) / resolution * 2 - 1 for c in (column, row))
        faces[face, row, column] = opengl_direction(face, x, y) / 2 + 0.5
    return torch.from_numpy(faces)


@dataclass
class StreetWorld:
    """A folder of 16 frames, and a model trained on frames 10 to 13 with cameras 0 and 1.

    ``rows`` holds the tracks of ``track_info.txt`` by frame, in file order. Track 5 is parked;
    7, 3, 8 (and 1) move; 9 is a sign. In frame 12 only camera 4 sees track 3.
    """

    rows: dict[int, list[int]] = field(
        default_factory=lambda: {
            2: [7],
            10: [5, 7, 9, 3],
            11: [7, 5, 3],
            12: [3, 5, 8, 7],
            13: [5, 8],
        }
    )
    columns: dict[tuple[int, int], int] = field(
        # Without track 5 two columns suffice, so the tracks are packed.
        default_factory=lambda: {
            (10, 7): 0,
            (10, 3): 1,
            (11, 7): 0,
            (11, 3): 1,
            (12, 8): 0,
            (12, 7): 1,
            (13, 8): 0,
        }
    )
    width: int = 2
    frames: range = range(10, 14)
    start: float = 1_550_083_467.3

    @classmethod
    def with_gaps(cls) -> StreetWorld:
        """A world whose frame 11 needs all three columns, so the columns of track 5 stay empty."""
        rows = {2: [7], 10: [5, 7, 9, 3], 11: [7, 1, 3], 12: [3, 5, 8, 7], 13: [5, 1, 8]}
        columns = {
            (10, 7): 1,
            (10, 3): 2,
            (11, 7): 0,
            (11, 1): 1,
            (11, 3): 2,
            (12, 8): 1,
            (12, 7): 2,
            (13, 1): 1,
            (13, 8): 2,
        }
        return cls(rows, columns, width=3)

    @property
    def movers(self) -> list[int]:
        return sorted({track for _, track in self.columns})

    def ego(self, frame: int) -> np.ndarray:
        """Pose of the ego in Waymo's world frame, far from the origin."""
        return pose(-25_211.0 + 3 * frame, 42_391.0 + frame, 7.5 + 0.01 * frame, 0.3 + 0.02 * frame)

    def centre(self) -> np.ndarray:
        return np.mean([self.ego(f)[:3, 3] for f in range(16)], axis=0)

    def ego_in_scene(self, frame: int) -> np.ndarray:
        moved = self.ego(frame).copy()
        moved[:3, 3] -= self.centre()
        return moved

    def given_in_vehicle(self, frame: int, track: int) -> tuple[np.ndarray, float]:
        """Position and heading of a box in the vehicle frame, as stored in the folder."""
        if track == 5:
            local = np.linalg.inv(self.ego(frame)) @ pose(-25_190, 42_410, 8, 1.0)
            return local[:3, 3], math.atan2(local[1, 0], local[0, 0])
        position = np.array([10.0 + track + 2 * frame, track - 4.0, 0.8])
        return position, 0.1 * track + 0.05 * frame

    def correction(self, frame: int, track: int) -> tuple[np.ndarray, float]:
        """Trained correction: shift [m] and theta [rad]."""
        return np.array([0.1, -0.2, 0.05]) * track + 0.01 * frame, 0.01 * track - 0.002 * frame

    def pose_in_scene(self, frame: int, track: int) -> np.ndarray:
        """Corrected pose of an object in the scene. Theta is applied twice."""
        position, heading = self.given_in_vehicle(frame, track)
        shift, theta = self.correction(frame, track)
        x, y, z = position + shift
        return self.ego_in_scene(frame) @ pose(x, y, z, heading + 2 * theta)

    def size(self, frame: int, track: int) -> tuple[float, float, float]:
        return (4.0 + 0.1 * track, 1.8, 1.5 + (0.5 if frame == 2 else 0.0))

    def seconds(self, frame: int) -> float:
        return self.start + 0.1 * frame

    def write_folder(self, folder: Path) -> Path:
        for name in ("ego_pose", "extrinsics", "intrinsics", "track", "images"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for frame in range(16):
            write_matrix(folder / "ego_pose" / f"{frame:06d}.txt", self.ego(frame))
            for camera in range(5):
                # Poses at the image times, which must not be used as frame poses.
                late = self.ego(frame) @ pose(0.3, 0, 0, 0.001)
                write_matrix(folder / "ego_pose" / f"{frame:06d}_{camera}.txt", late)
        for camera in range(5):
            optical = np.array(
                [[0, 0, 1, 1.5], [-1, 0, 0, 0.1 * camera], [0, -1, 0, 2], [0, 0, 0, 1]]
            )
            write_matrix(folder / "extrinsics" / f"{camera}.txt", optical)
            numbers = [2000 + camera, 2001, 960, 640, 0.1, -0.3, 0, 0, 0]
            write_matrix(folder / "intrinsics" / f"{camera}.txt", numbers)
        stamps = {f"{f:06d}": self.seconds(f) for f in range(16)}
        (folder / "timestamps.json").write_text(json.dumps({"FRAME": stamps}))
        self._write_tracks(folder / "track")
        return folder

    def _write_tracks(self, place: Path) -> None:
        lines = ["frame_id track_id object_class alpha h w l x y z heading speed"]
        seen: dict[str, dict[str, list[int]]] = {}
        for frame, tracks in self.rows.items():
            for track in tracks:
                (x, y, z), heading = self.given_in_vehicle(frame, track)
                length, width, height = self.size(frame, track)
                category = {9: "sign", 8: "pedestrian"}.get(track, "vehicle")
                numbers = [height, width, length, x, y, z, heading, 1.0]
                words = " ".join(repr(float(n)) for n in numbers)
                lines.append(f"{frame} {track} {category} -10 {words}")
                hidden = (frame, track) == (12, 3)
                seen.setdefault(str(track), {})[str(frame)] = [4] if hidden else [0, 3]
        (place / "track_info.txt").write_text("\n".join(lines) + "\n")
        (place / "track_camera_vis.json").write_text(json.dumps(seen))

    def state(self, **parts: Any) -> dict[str, Any]:
        """A checkpoint. ``parts`` replace or add entries; None removes them."""
        shift = torch.zeros(len(self.frames), self.width, 3)
        theta = torch.zeros(len(self.frames), self.width, 1)
        for (frame, track), column in self.columns.items():
            moved, turned = self.correction(frame, track)
            shift[frame - 10, column] = torch.from_numpy(moved)
            theta[frame - 10, column] = turned
        state: dict[str, Any] = {"background": street_model(30, seed=99)}
        for track in self.movers:
            state[f"obj_{track:03d}"] = street_model(10 + track, fourier=5, seed=track)
        state["actor_pose"] = {"params": {"opt_trans": shift, "opt_rots": theta}}
        state["sky_cubemap"] = {"params": {"sky_cube_map": direction_cube(8)}}
        state["iter"] = 50_000
        return {k: v for k, v in (state | parts).items() if v is not None}


def studio_model(
    count: int, *, harmonics: int = 3, scales: int = 3, seed: int = 0
) -> dict[str, torch.Tensor]:
    """Gaussians of a drivestudio model."""
    random = torch.Generator().manual_seed(seed)
    shapes = {
        "_means": (count, 3),
        "_scales": (count, scales),
        "_quats": (count, 4),
        "_features_dc": (count, 3),
        "_features_rest": (count, harmonics, 3),
        "_opacities": (count, 1),
    }
    return {k: torch.randn(*s, generator=random) for k, s in shapes.items()}


def studio_state(**models: Any) -> dict[str, Any]:
    """A drivestudio checkpoint: 5 frames, 3 instances, the last of which is never visible."""
    rigid = studio_model(24, seed=3)
    quats, positions = torch.zeros(5, 3, 4), torch.zeros(5, 3, 3)
    visible = torch.zeros(5, 3, dtype=torch.bool)
    for frame in range(5):
        for instance in range(3):
            yaw = 0.3 * instance + 0.1 * frame
            # Not normalized, like trained parameters.
            quats[frame, instance] = 1.7 * torch.tensor(
                [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
            )
            positions[frame, instance] = torch.tensor([10.0 * instance + frame, 2.0, 0.5])
    visible[:, 0] = True
    visible[1:4, 1] = True
    rigid |= {
        "instances_quats": quats,
        "instances_trans": positions,
        "instances_size": torch.tensor([[4.5, 1.9, 1.6], [8.0, 2.5, 3.0], [4.0, 1.8, 1.5]]),
        "instances_fv": visible,
        "points_ids": (torch.arange(24) % 3)[:, None],
    }
    found: dict[str, Any] = {
        "Background": studio_model(40, seed=1),
        "RigidNodes": rigid,
        "Sky": {"base": direction_cube(8)},
    }
    return {
        "models": {k: v for k, v in (found | models).items() if v is not None},
        "step": 30_000,
    }
