"""How a scene of another simulator is found here: its frame, its clock, its names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from real2sim_proto.scenes import SceneInfo

from .._poses import Matrix
from .._replies import describe

Row = tuple[float, float, float, float]
IDENTITY: tuple[Row, Row, Row, Row] = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, 1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0, 0.0),
    (0.0, 0.0, 0.0, 1.0),
)


class SceneLink(BaseModel):
    """One scene of the worker, as another simulator counts in it.

    Attributes:
        scene: its name here.
        T_world_theirs: from their world to the scene's; None: as the scene says that it was made,
            else the same.
        offset_us: their time less the scene's [us].
        cameras: the scene's cameras by their names.
        objects: the scene's objects by their ids; besides those that the scene knows from its log.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: str = Field(min_length=1)
    T_world_theirs: tuple[Row, Row, Row, Row] | None = None
    offset_us: int = 0
    cameras: dict[str, str] = Field(default_factory=dict)
    objects: dict[str, str] = Field(default_factory=dict)

    @field_validator("T_world_theirs")
    @classmethod
    def _is_rigid(cls, rows: Any) -> Any:
        if rows is not None:
            R, last = np.array(rows)[:3, :3], rows[3]
            turns = np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0
            if not turns or last != IDENTITY[3]:
                raise ValueError("T_world_theirs is no rigid transform [4, 4]")
        return rows


def read_links(path: Path) -> dict[str, SceneLink]:
    """Links by their scene's id, out of a JSON file.

    Raises:
        ValueError: the file holds something else.
        OSError: it cannot be read.
    """
    try:
        return TypeAdapter(dict[str, SceneLink]).validate_json(path.read_bytes())
    except ValidationError as error:
        raise ValueError(f"{path}: {describe(error)}") from error


def frame_of(link: SceneLink, info: SceneInfo) -> Matrix:
    """``T_world_theirs`` [4, 4]; readers of logs note where the world of their files is."""
    rows = link.T_world_theirs or info.provenance.get("T_world_dataset") or IDENTITY
    return np.array(rows, dtype=np.float64)


def object_ids(link: SceneLink, info: SceneInfo) -> dict[str, str]:
    """The scene's objects by their ids: those of the log that it was made of, and its own."""
    there = [found.object_id for found in info.objects]
    keys = info.provenance.get("track_ids")
    named = {str(key): name for name, key in _pairs(keys) if name in there}
    return {name: name for name in there} | named | dict(link.objects)


def camera_names(link: SceneLink, wanted: Iterable[str], info: SceneInfo) -> dict[str, str]:
    """The link's names, and those of ``wanted`` that differ from a camera's by case alone."""
    by_case = {camera.name.lower(): camera.name for camera in info.cameras}
    alike = {name: by_case[name.lower()] for name in wanted if name.lower() in by_case}
    return alike | dict(link.cameras)


def _pairs(keys: Any) -> Iterable[tuple[str, Any]]:
    return keys.items() if isinstance(keys, Mapping) else ()
