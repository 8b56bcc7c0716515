"""What a REST call is made of: a request, and how its reply is read."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from real2sim_proto.base import bearer_token

from ._models import sent_fields
from ._replies import MEDIA_TYPES, Reply, describe, parse_image
from .images import Image

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class Request:
    """What goes out. ``idempotent`` requests may be sent again when no reply came."""

    method: str
    path: str
    params: dict[str, str] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes | None = None
    form: dict[str, str] = field(default_factory=dict)
    upload: Path | None = None
    idempotent: bool = True
    long_timeout: bool = False
    accepted: frozenset[int] = frozenset()

    def __str__(self) -> str:
        return f"{self.method} {self.path}"


@dataclass(frozen=True)
class Call(Generic[T]):
    """A request and how its reply is read."""

    request: Request
    parse: Callable[[Reply], T]


@dataclass(frozen=True)
class ViewRequest:
    """One image of one camera at one instant; ``codec`` is never 'auto' here."""

    camera: str
    t_us: int | None
    width: int | None
    modality: str
    codec: str


def checked(model: type[M], /, **fields: Any) -> M:
    """A model of these fields.

    Raises:
        ValueError: one sentence that names every field that is not allowed, and why.
    """
    try:
        return model(**fields)
    except ValidationError as error:
        raise ValueError(f"{model.__name__}: {describe(error, model)}") from error


def instant_us(t: float | None, t_us: float | None) -> int | None:
    """An instant given in seconds or in microseconds; None: neither.

    Raises:
        ValueError: given both ways, or no whole number of microseconds.
    """
    if t is not None and t_us is not None:
        raise ValueError(f"t={t!r} (seconds) and t_us={t_us!r} (microseconds); give one of them")
    if t is not None:
        return round(t * 1e6)
    if t_us is None or t_us == int(t_us):
        return None if t_us is None else int(t_us)
    raise ValueError(f"t_us is {t_us!r}; give whole microseconds, or seconds as t={t_us!r}")


def new_key() -> str:
    """An Idempotency-Key: made once a call, the same for all its tries."""
    return uuid.uuid4().hex


def post(
    path: str,
    body: BaseModel | None,
    *,
    params: dict[str, str] | None = None,
    if_match: str | None = None,
    long_timeout: bool = False,
) -> Request:
    """A POST that may be tried again: the worker knows it by its Idempotency-Key."""
    headers = {"Idempotency-Key": new_key()}
    if body is not None:
        headers["Content-Type"] = "application/json"
    if if_match is not None:
        headers["If-Match"] = if_match
    content = None if body is None else json_of(body)
    return Request("POST", path, params or {}, headers, content, long_timeout=long_timeout)


def file_put(path: str, content: bytes, media_type: str, *, if_match: str) -> Request:
    """A PUT of a file's content that may be tried again, as a POST may."""
    headers = {"Idempotency-Key": new_key(), "Content-Type": media_type, "If-Match": if_match}
    return Request("PUT", path, {}, headers, content, long_timeout=True)


def upload(path: str, file: Path, form: dict[str, str]) -> Request:
    """A POST of a file with form fields."""
    key = new_key()
    # The boundary follows from the key, so that every try sends the same bytes.
    headers = {
        "Idempotency-Key": key,
        "Content-Type": f"multipart/form-data; boundary=real2sim-{key}",
    }
    return Request("POST", path, headers=headers, form=form, upload=file, long_timeout=True)


def json_of(body: BaseModel) -> bytes:
    """What was set of the model, as JSON."""
    return json.dumps(sent_fields(body), allow_nan=False, separators=(",", ":")).encode()


def segment(name: str) -> str:
    """A name as one part of a path. Raises ValueError for what cannot be one."""
    if not name or name in {".", ".."}:
        raise ValueError(f"{name!r} is not a name that a path can hold")
    return quote(name, safe="")


def bearer(token: str | None) -> dict[str, str]:
    """The header that shows a token. Raises ValueError for one that a header cannot hold."""
    return {} if token is None else {"Authorization": f"Bearer {bearer_token(token)}"}


def image(path: str, view: ViewRequest) -> Call[Image]:
    """A picture. Raises ValueError for an unknown codec."""
    if view.codec not in MEDIA_TYPES:
        allowed = ", ".join(("auto", *MEDIA_TYPES))
        raise ValueError(f"codec {view.codec!r} is unknown; allowed are {allowed}")
    params = {"camera": view.camera, "modality": view.modality}
    params |= {} if view.t_us is None else {"t_us": str(view.t_us)}
    params |= {} if view.width is None else {"width": str(view.width)}
    headers = {"Accept": MEDIA_TYPES[view.codec]}
    request = Request("GET", path, params, headers, long_timeout=True)
    return Call(request, lambda reply: parse_image(reply, view.modality))
