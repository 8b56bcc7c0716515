"""REST calls without the network: requests, replies, their models, and when to retry."""

from __future__ import annotations

import functools
import json
import math
import random
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, get_args, get_origin
from urllib.parse import quote

from pydantic import BaseModel, TypeAdapter, ValidationError

from real2sim_proto import RETRYABLE, CodecError, decode
from real2sim_proto.base import bearer_token, invalid_reason
from real2sim_proto.drive import Frame as WireFrame
from real2sim_proto.drive import PointCloud as WireCloud
from real2sim_proto.scenarios import HistoryEntry

from ._handles import argument_advice
from .clouds import LidarCloud, cloud_from_wire
from .errors import ErrorDetails, InvalidValue, MalformedReplyError, Real2SimError, error_for
from .images import Image, encoded_shape, frame_from_wire
from .observation import View, view_from_frames

RETRYABLE_STATUS = frozenset({408, 429, 502, 503, 504})

RETRYABLE_CODES = frozenset(code.value for code in RETRYABLE)
"""Protocol error codes that are temporary, regardless of the HTTP status."""


@dataclass(frozen=True)
class RetryPolicy:
    """Exponential back-off with jitter; the worker's ``Retry-After`` takes precedence.

    Attributes:
        retries: retries after the first try; 0 disables them.
        first_delay: seconds before the first retry; doubles with each.
        max_delay: maximum back-off in seconds.
        max_retry_after: longest accepted ``Retry-After`` in seconds; longer ones end retries.
    """

    retries: int = 2
    first_delay: float = 0.5
    max_delay: float = 8.0
    max_retry_after: float = 120.0

    def __post_init__(self) -> None:
        if self.retries < 0:
            raise ValueError(f"retries is {self.retries!r}; give 0 or more")

    def delay(
        self,
        attempt: int,
        *,
        retry_after: float | None = None,
        jitter: Callable[[], float] = random.random,
    ) -> float | None:
        """Seconds to wait after failed try number ``attempt`` (0 is the first); None to give up."""
        if attempt >= self.retries:
            return None
        if retry_after is not None:
            return retry_after if retry_after <= self.max_retry_after else None
        backoff = min(self.first_delay * 2.0**attempt, self.max_delay)
        return backoff * (1.0 - 0.25 * jitter())


def parse_retry_after(value: str | None, *, now: float | None = None) -> float | None:
    """Seconds of a ``Retry-After`` header (a number or an HTTP date), or None."""
    if value is None:
        return None
    try:
        seconds = float(value)
    except ValueError:
        try:
            moment = parsedate_to_datetime(value).timestamp()
        except ValueError:
            return None
        seconds = moment - (time.time() if now is None else now)
    return None if math.isnan(seconds) else max(seconds, 0.0)


# Models between clients and workers of different versions.
#
# Requests only contain members that the caller has set, so that an older worker receives nothing
# unknown and a newer worker applies its defaults. Unknown members of replies are ignored, even in
# models that the worker parses strictly.

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")

_UNKNOWN_VALUES = frozenset({"literal_error", "union_tag_invalid"})
"""Validation errors caused by values that only a newer worker knows."""


def sent_fields(model: BaseModel) -> dict[str, Any]:
    """Fields of a model to send: those that were set, and constants such as ``type`` and ``kind``.

    None is omitted if it is the default, and sent otherwise.
    """
    fields, known = {}, type(model).model_fields
    constants, given = _constants(type(model)), model.model_fields_set
    for name, value in vars(model).items():
        if name in constants or (
            name in given and (value is not None or _null_differs(known[name]))
        ):
            fields[name] = _sent(value)
    return fields


def read_fields(messages: TypeAdapter[T], fields: Mapping[str, Any]) -> T:
    """Parse a worker's message, ignoring unknown members. Raises ValidationError."""
    return messages.validate_python(fields, extra="ignore")


def read_json(model: type[M], content: bytes) -> M:
    """Parse a worker's answer; unknown members are ignored.

    An unknown value of an enumeration is dropped: a list omits it, a member gets its default.

    Raises:
        ValidationError: the content does not fit the model.
    """
    try:
        return model.model_validate_json(content, extra="ignore")
    except ValidationError as error:
        problems = error.errors(include_url=False, include_context=False, include_input=False)
        if any(problem["type"] not in _UNKNOWN_VALUES for problem in problems):
            raise
        fields = json.loads(content)
        # Remove from the end of lists, so that earlier indices stay valid.
        for problem in reversed(problems):
            _leave_out(fields, problem["loc"])
        return model.model_validate(fields, extra="ignore")


def _sent(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return sent_fields(value)
    if isinstance(value, list | tuple) and value and isinstance(value[0], BaseModel):
        return [sent_fields(item) for item in value]
    if isinstance(value, dict):
        return {key: _sent(item) for key, item in value.items()}
    return value


def _null_differs(field: Any) -> bool:
    """Whether None differs from the default of a member."""
    return field.is_required() or field.get_default(call_default_factory=True) is not None


@functools.cache
def _constants(model: type[BaseModel]) -> frozenset[str]:
    """Members with only one possible value."""
    return frozenset(
        name
        for name, field in model.model_fields.items()
        if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1
    )


def _leave_out(fields: Any, place: tuple[int | str, ...]) -> None:
    """Remove the innermost item or member that an error's location names.

    Locations also contain names of union members, which the value does not have.
    """
    holder, key, inside = None, None, fields
    for part in place:
        known = isinstance(inside, dict) and part in inside
        if known or (isinstance(inside, list) and isinstance(part, int) and part < len(inside)):
            holder, key, inside = inside, part, inside[part]
    if holder is not None:
        del holder[key]


# Replies.

MSGPACK = "application/msgpack"
MEDIA_TYPES = {"raw": MSGPACK, "jpeg": "image/jpeg", "png": "image/png"}


@dataclass(frozen=True)
class Reply:
    """A response; header names in lower case."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def media_type(self) -> str:
        return self.headers.get("content-type", "").partition(";")[0].strip().lower()


def error_from_reply(reply: Reply) -> Real2SimError:
    """The exception for a reply with status 400 or above, with or without a problem document."""
    try:
        problem = json.loads(reply.content)
    except ValueError:
        problem = None
    retry_after = parse_retry_after(reply.headers.get("retry-after"))
    if not isinstance(problem, dict):
        text = reply.content[:200].decode("utf-8", "replace").strip() or "empty body"
        detail = f"the answer has status {reply.status} and is not a problem document: {text!r}"
        return error_for(ErrorDetails(reply.status, "UNKNOWN", detail, retry_after=retry_after))
    return error_for(
        ErrorDetails(
            status=reply.status,
            code=str(problem.get("code", "UNKNOWN")),
            detail=str(problem.get("detail") or problem.get("title") or f"status {reply.status}"),
            hint=_text(problem.get("hint")),
            request_id=_text(problem.get("request_id")) or reply.headers.get("x-request-id"),
            errors=tuple(_invalid_values(problem.get("errors"))),
            retry_after=retry_after,
            revision=problem["revision"] if isinstance(problem.get("revision"), int) else None,
            missed=tuple(_missed(problem.get("missed"))),
        )
    )


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) and value else None


def _invalid_values(values: Any) -> list[InvalidValue]:
    if not isinstance(values, list):
        return []
    return [
        InvalidValue(str(value.get("pointer", "")), str(value.get("message", "")))
        for value in values
        if isinstance(value, dict)
    ]


def _missed(values: Any) -> list[HistoryEntry]:
    entries = []
    for value in values if isinstance(values, list) else []:
        try:
            entries.append(HistoryEntry.model_validate(value, extra="ignore"))
        except ValidationError:
            # The error is more important than an entry in a newer worker's format.
            continue
    return entries


def nothing(_reply: Reply) -> None:
    return None


def model_of(model: type[M], *, whole: bool = False) -> Callable[[Reply], M]:
    """A parser of replies; ``whole`` keeps unknown members, for models that are sent back later."""

    def parse(reply: Reply) -> M:
        try:
            if whole:
                return model.model_validate_json(reply.content)
            return read_json(model, reply.content)
        except ValidationError as error:
            raise MalformedReplyError(
                f"the worker's answer is not a {model.__name__}: {describe(error)}",
                hint="is this address a Real2Sim worker, of this protocol version?",
            ) from error

    return parse


def parse_image(reply: Reply, modality: str) -> Image:
    if reply.media_type == MSGPACK:
        return frame_from_wire(_wire_frame(_decoded(reply)))
    codecs = {media_type: codec for codec, media_type in MEDIA_TYPES.items()}
    codec = codecs.get(reply.media_type)
    if codec is None:
        raise MalformedReplyError(f"the worker sent {reply.media_type!r} instead of an image")
    dtype = "uint8" if modality in ("rgb", "semantic") else "uint16"
    shape = encoded_shape(reply.content, codec)
    return Image(data=reply.content, codec=codec, modality=modality, dtype=dtype, shape=shape)


def parse_sweep(reply: Reply) -> LidarCloud:
    cloud = cloud_from_wire(_wire_cloud(_decoded(reply)))
    if not isinstance(cloud, LidarCloud):
        raise MalformedReplyError(f"the worker sent a {cloud.modality} cloud for a sweep")
    return cloud


def parse_view(reply: Reply) -> View:
    message = _decoded(reply)
    frames = message.get("frames")
    if not isinstance(frames, list):
        raise MalformedReplyError("the worker's answer to render has no list of frames")
    wires = [_wire_frame(frame) for frame in frames]
    return view_from_frames(
        wires,
        t_us=int(message.get("t_us", wires[0].t_us if wires else 0)),
        revision=int(message.get("revision", 0)),
        timing=message.get("timing", {}),
        clouds=[_wire_cloud(cloud) for cloud in message.get("clouds", ())],
    )


def _decoded(reply: Reply) -> dict[str, Any]:
    try:
        return decode(reply.content)
    except CodecError as error:
        raise MalformedReplyError(f"the worker's answer cannot be read: {error}") from error


def _wire_frame(value: Any) -> WireFrame:
    known = {k: v for k, v in dict(value).items() if k in WireFrame.model_fields}
    try:
        return WireFrame.model_validate(known)
    except ValidationError as error:
        raise MalformedReplyError(f"the worker sent a broken frame: {describe(error)}") from error


def _wire_cloud(value: Any) -> WireCloud:
    try:
        return WireCloud.model_validate(value)
    except ValidationError as error:
        raise MalformedReplyError(f"the worker sent a broken cloud: {describe(error)}") from error


def describe(error: ValidationError, model: type[BaseModel] | None = None) -> str:
    """Up to four errors in one line: ``sensors/0/width: must be ...``.

    For an unknown member of the model, suggests a valid name.
    """
    members = list(model.model_fields) if model else []
    problems = []
    for problem in error.errors(include_url=False, include_context=False)[:4]:
        place = "/".join(str(part) for part in problem["loc"])
        if members and problem["type"] == "extra_forbidden" and len(problem["loc"]) == 1:
            problems.append(f"there is no {place!r}; {argument_advice(place, members)}")
        else:
            problems.append(f"{place}: {invalid_reason(problem)}")
    more = error.error_count() - len(problems)
    return "; ".join(problems) + (f"; and {more} more" if more > 0 else "")


# Calls: a request and how its reply is read.


@dataclass(frozen=True)
class Request:
    """A request. ``idempotent`` requests may be repeated if no reply arrives."""

    method: str
    path: str
    params: dict[str, str] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict, repr=False)
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
    """A model with these fields.

    Raises:
        ValueError: lists up to four invalid fields with the reasons.
    """
    try:
        return model(**fields)
    except ValidationError as error:
        raise ValueError(f"{model.__name__}: {describe(error, model)}") from error


def instant_us(t: float | None, t_us: float | None) -> int | None:
    """A time given in seconds or in microseconds, in microseconds; None if neither is given.

    Raises:
        ValueError: both are given, or ``t_us`` is not a whole number.
    """
    if t is not None and t_us is not None:
        raise ValueError(f"t={t!r} (seconds) and t_us={t_us!r} (microseconds); give one of them")
    if t is not None:
        return round(t * 1e6)
    if t_us is None or t_us == int(t_us):
        return None if t_us is None else int(t_us)
    raise ValueError(f"t_us is {t_us!r}; give whole microseconds, or seconds as t={t_us!r}")


def new_key() -> str:
    """A new Idempotency-Key; all attempts of a call share one key."""
    return uuid.uuid4().hex


def post(
    path: str,
    body: BaseModel | None,
    *,
    params: dict[str, str] | None = None,
    if_match: str | None = None,
    long_timeout: bool = False,
) -> Request:
    """A POST that is safe to retry: its Idempotency-Key identifies it to the worker."""
    headers = {"Idempotency-Key": new_key()}
    if body is not None:
        headers["Content-Type"] = "application/json"
    if if_match is not None:
        headers["If-Match"] = if_match
    content = None if body is None else json_of(body)
    return Request("POST", path, params or {}, headers, content, long_timeout=long_timeout)


def file_put(path: str, content: bytes, media_type: str, *, if_match: str) -> Request:
    """A PUT of a file's content, safe to retry like :func:`post`."""
    headers = {"Idempotency-Key": new_key(), "Content-Type": media_type, "If-Match": if_match}
    return Request("PUT", path, {}, headers, content, long_timeout=True)


def upload(path: str, file: Path, form: dict[str, str]) -> Request:
    """A POST of a file with form fields."""
    key = new_key()
    # The boundary derives from the key, so that every attempt sends the same bytes.
    headers = {
        "Idempotency-Key": key,
        "Content-Type": f"multipart/form-data; boundary=real2sim-{key}",
    }
    return Request("POST", path, headers=headers, form=form, upload=file, long_timeout=True)


def json_of(body: BaseModel) -> bytes:
    """The fields set in a model, as JSON."""
    return json.dumps(sent_fields(body), allow_nan=False, separators=(",", ":")).encode()


def segment(name: str) -> str:
    """A name as one path segment. Raises ValueError if it cannot be one."""
    if not name or name in {".", ".."}:
        raise ValueError(f"{name!r} is not a name that a path can hold")
    return quote(name, safe="")


def bearer(token: str | None) -> dict[str, str]:
    """The Authorization header of a token. Raises ValueError for an invalid token."""
    return {} if token is None else {"Authorization": f"Bearer {bearer_token(token)}"}


def image(path: str, view: ViewRequest) -> Call[Image]:
    """An image request. Raises ValueError for an unknown codec."""
    if view.codec not in MEDIA_TYPES:
        allowed = ", ".join(("auto", *MEDIA_TYPES))
        raise ValueError(f"codec {view.codec!r} is unknown; allowed are {allowed}")
    params = {"camera": view.camera, "modality": view.modality}
    params |= {} if view.t_us is None else {"t_us": str(view.t_us)}
    params |= {} if view.width is None else {"width": str(view.width)}
    headers = {"Accept": MEDIA_TYPES[view.codec]}
    request = Request("GET", path, params, headers, long_timeout=True)
    return Call(request, lambda reply: parse_image(reply, view.modality))
