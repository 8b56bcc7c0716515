"""Base model, the value types that all messages share, and hints for misspelled names."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    SupportsIndex,
    TypeVar,
    get_args,
    overload,
)

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

# Errors for missing names, with a suggestion.

MAX_SHOWN = 24


class Guided:
    """Base of the objects users hold: the error for an unknown attribute suggests the right one.

    Subclasses list in ``_instead`` the names that users often try, and their replacements.
    """

    _instead: ClassVar[Mapping[str, str]] = {}

    # Hidden from type checkers, which would otherwise accept every attribute.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            kind = type(self).__name__
            # Libraries probe private names and catch the error; a hint is not useful.
            if name.startswith("_"):
                raise AttributeError(f"{kind!r} object has no attribute {name!r}")
            said = advice(name, attributes(self), instead_of(type(self)))
            raise AttributeError(f"{kind} has no {name!r}; {said}")


def instead_of(kind: type) -> Mapping[str, str]:
    """Replacements for unknown names, of a class and its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        found |= vars(base).get("_instead", {})
    return found


def attributes(thing: object) -> list[str]:
    """Public names of an object; for a message, only its members."""
    members = getattr(type(thing), "model_fields", None)
    return [name for name in members or dir(thing) if not name.startswith("_")]


def advice(
    name: str,
    there: Iterable[str],
    instead: Mapping[str, str] | None = None,
    *,
    otherwise: str = "there are",
) -> str:
    """Suggestion for an unknown name: the known replacement, else similar names, else all names."""
    if instead and name in instead:
        return f"write {instead[name]}"
    if close := difflib.get_close_matches(name, there := list(there), n=2):
        return f"did you mean {' or '.join(close)}?"
    shown = there if len(there) <= MAX_SHOWN else [*there[:MAX_SHOWN], "..."]
    return f"{otherwise} {', '.join(shown) or 'none'}"


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
        # Unit quaternions are kept bit for bit: reading stored values must not change them.
        return quaternion
    w, x, y, z = quaternion
    return (w / norm, x / norm, y / norm, z / norm)


Quaternion = Annotated[
    tuple[float, float, float, float],
    AfterValidator(_unit),
    Field(description="wxyz, unit length within 1e-3"),
]


# Reasons for invalid values.

MAX_GIVEN = 60
"""Longest value that a reason shows [characters]."""
SECRETS = ("token", "secret")
"""Members whose values are never shown."""

_SHOULD = re.compile(r"^(?:[A-Z][a-z]+|URL|JSON) should ")


def invalid_reason(problem: Mapping[str, Any]) -> str:
    """Why a value is invalid, without its place: ``must be a finite number, got NaN``.

    Args:
        problem: an entry of pydantic's ``ValidationError.errors()``.
    """
    kind, place = problem["type"], problem["loc"]
    message = str(problem["msg"]).removeprefix("Value error, ")
    if kind == "missing":
        return "is missing"
    if kind == "extra_forbidden":
        return "is not a known member"
    said = _SHOULD.sub("must ", message)
    told = said == message or ", not " in said or "input" not in problem
    if told or (place and place[-1] in SECRETS):
        return said
    value = problem["input"]
    if isinstance(value, float) and not math.isfinite(value):
        given = "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    else:
        given = repr(value)
    return f"{said}, got {given}" if len(given) <= MAX_GIVEN else said


MAX_TOKEN = 500
"""Longest token [characters]."""


def bearer_token(text: str) -> str:
    """A token for a header, without the surrounding white space that files and shells add.

    Raises:
        ValueError: the token is too long, or has characters that a header cannot contain. The
            message does not show the token.
    """
    token = text.strip()
    if len(token) > MAX_TOKEN:
        raise ValueError(f"the token has {len(token)} characters; at most {MAX_TOKEN} are allowed")
    for place, character in enumerate(token, 1):
        if not " " <= character <= "~":
            raise ValueError(
                f"character {place} of the token is U+{ord(character):04X}; a token is printable "
                "ASCII on one line"
            )
    return token


def one_of(values: Any) -> Any:
    """Field of a reply with one of a ``Literal``'s values. Newer workers may send other values, and
    readers accept them."""
    return Field(json_schema_extra={"enum": list(get_args(values))})


class Model(Guided, BaseModel):
    """Immutable, closed to unknown fields, finite numbers only."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, ser_json_inf_nan="constants"
    )


N = TypeVar("N")


class Named(list[N]):
    """A list that also looks up items by ``object_id`` or ``name``: ``cameras["front"]``.

    Attributes:
        filled_by: how to fill the list; shown by the error of a lookup in an empty list.
    """

    def __init__(self, items: Iterable[N] = (), *, filled_by: str = "") -> None:
        super().__init__(items)
        self.filled_by = filled_by

    @overload
    def __getitem__(self, key: str | SupportsIndex) -> N: ...
    @overload
    def __getitem__(self, key: slice) -> list[N]: ...
    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        found = {_name_of(item): item for item in self}
        if key in found:
            return found[key]
        raise KeyError(f"no {key!r}; {'' if self else self.filled_by} {advice(key, found)}")

    @classmethod
    def __get_pydantic_core_schema__(cls, kind: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        inner = handler.generate_schema(list[get_args(kind)[0]])  # type: ignore[misc]
        return core_schema.no_info_after_validator_function(cls, inner)


def _name_of(item: Any) -> str:
    name: str = getattr(item, "object_id", None) or item.name
    return name


class Pose(Model):
    """Rigid pose ``T_world_x``."""

    position: Vector3 = Field(description="origin of the frame in the world [m]")
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Track(Model):
    """Poses at increasing time stamps; T entries each."""

    times_us: list[Microseconds] = Field(min_length=1, max_length=100_000)
    positions: list[Vector3]
    quaternions: list[Quaternion]
