"""How the answers of REST calls are read."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from real2sim_proto import CodecError, decode
from real2sim_proto.drive import Frame as WireFrame
from real2sim_proto.drive import PointCloud as WireCloud
from real2sim_proto.scenarios import HistoryEntry

from ._guidance import argument_advice
from ._models import read_json
from ._retry import parse_retry_after
from .clouds import LidarCloud, cloud_from_wire
from .errors import ErrorDetails, InvalidValue, MalformedReplyError, Real2SimError, error_for
from .images import Image, encoded_shape, frame_from_wire
from .observation import View, view_from_frames

M = TypeVar("M", bound=BaseModel)

MSGPACK = "application/msgpack"
MEDIA_TYPES = {"raw": MSGPACK, "jpeg": "image/jpeg", "png": "image/png"}


@dataclass(frozen=True)
class Reply:
    """What came back; header names in lower case."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def media_type(self) -> str:
        return self.headers.get("content-type", "").partition(";")[0].strip().lower()


def error_from_reply(reply: Reply) -> Real2SimError:
    """The exception for an answer of status 400 or above, problem document or not."""
    try:
        problem = json.loads(reply.content)
    except ValueError:
        problem = None
    retry_after = parse_retry_after(reply.headers.get("retry-after"))
    if not isinstance(problem, dict):
        text = reply.content[:200].decode("utf-8", "replace").strip() or "empty body"
        detail = f"the answer has status {reply.status} and is no problem document: {text!r}"
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
            # The error matters more than one entry that a newer worker writes differently.
            continue
    return entries


def nothing(_reply: Reply) -> None:
    return None


def model_of(model: type[M], *, whole: bool = False) -> Callable[[Reply], M]:
    """Reads answers that are a model; ``whole``: one that will be given back some day, of which
    nothing may get lost."""

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
        raise MalformedReplyError(f"the worker sent {reply.media_type!r} where an image was asked")
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
    """What is wrong, in one line: ``sensors/0/width: input should be ...``.

    Of the model's own members that are not there it says which are meant.
    """
    members = list(model.model_fields) if model else []
    problems = []
    for problem in error.errors(include_url=False, include_context=False)[:4]:
        place = "/".join(str(part) for part in problem["loc"])
        given = repr(problem["input"])
        given = given if len(given) <= 60 else f"{given[:57]}..."
        if members and problem["type"] == "extra_forbidden" and len(problem["loc"]) == 1:
            problems.append(f"there is no {place!r}; {argument_advice(place, members)}")
        else:
            problems.append(f"{place}: {problem['msg']}, not {given}")
    more = error.error_count() - len(problems)
    return "; ".join(problems) + (f"; and {more} more" if more > 0 else "")
