"""Base model and the value types that all messages share."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

ID_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.\-]{0,79}$"

Identifier = Annotated[str, Field(pattern=ID_PATTERN)]
"""Id of a scene, object, camera or scenario: letters, digits, ``_``, ``.``, ``-``; 80 at most."""

Metres = Annotated[float, Field(ge=-1e6, le=1e6)]
Microseconds = Annotated[int, Field(ge=-(2**62), le=2**62)]
Codec = Literal["raw", "jpeg", "png"]
Modality = Literal["rgb", "depth", "instance", "median_depth", "semantic", "uncertainty"]
Vector3 = tuple[Metres, Metres, Metres]


def _unit(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = sum(q * q for q in quaternion) ** 0.5
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(
            f"quaternion {quaternion!r} has length {norm:.6g}; a rotation needs a unit one, wxyz"
        )
    if abs(norm - 1.0) < 1e-15:
        # Left bit for bit, so that reading back what was stored changes nothing.
        return quaternion
    w, x, y, z = quaternion
    return (w / norm, x / norm, y / norm, z / norm)


Quaternion = Annotated[
    tuple[float, float, float, float],
    AfterValidator(_unit),
    Field(description="wxyz, unit length within 1e-3"),
]


def bearer_token(text: str) -> str:
    """A token as a header holds it: without white space around it, which files and shells add.

    Raises:
        ValueError: it holds what no header may hold. The sentence does not show the token.
    """
    token = text.strip()
    for place, character in enumerate(token, 1):
        if not " " <= character <= "~":
            raise ValueError(
                f"character {place} of the token is U+{ord(character):04X}; a token is printable "
                "ASCII on one line"
            )
    return token


def one_of(values: Any) -> Any:
    """Field of an answer that has one of a ``Literal``'s values today; newer workers may have more,
    and readers take them as they come."""
    return Field(json_schema_extra={"enum": list(get_args(values))})


class Model(BaseModel):
    """Immutable, closed to unknown fields, finite numbers only."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, ser_json_inf_nan="constants"
    )


class Pose(Model):
    """Rigid pose ``T_world_x``."""

    position: Vector3 = Field(description="origin of the frame in the world [m]")
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Track(Model):
    """Poses at increasing time stamps; T entries each."""

    times_us: list[Microseconds] = Field(min_length=1, max_length=100_000)
    positions: list[Vector3]
    quaternions: list[Quaternion]
