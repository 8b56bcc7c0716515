"""Frames as HTTP answers, in the form that the client accepts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fastapi import Response

from real2sim_proto import encode as encode_message
from real2sim_proto.base import Codec, Modality

from ...render.modalities import modality_of
from ..http.responses import choose_among, etag
from .renderer import RenderedFrames

CODEC_OF: dict[str, Codec] = {
    "image/jpeg": "jpeg",
    "image/png": "png",
    "application/msgpack": "raw",
}
"""Codec by media type; the order is that of preference."""

FRAME_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "one frame, in the form that Accept picks",
        "content": {
            "image/jpeg": {"schema": {"type": "string", "format": "binary"}},
            "image/png": {"schema": {"type": "string", "format": "binary"}},
            "application/msgpack": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}


def choose_media_type(accept: str | None, modality: Modality) -> str:
    """The media type that the client likes best (RFC 9110, section 12.5.1).

    Raises:
        ServiceError: NOT_ACCEPTABLE when there is none; depth and instance are never jpeg.
    """
    codecs = modality_of(modality).codecs
    offered = [media_type for media_type, codec in CODEC_OF.items() if codec in codecs]
    return choose_among(offered, accept, of=f"modality {modality!r}")


MSGPACK = "application/msgpack"


def choose_frames_type(accept: str | None, modalities: Sequence[Modality]) -> str:
    """The same for images of these modalities: msgpack, or, for one image, any of its forms."""
    if len(modalities) == 1:
        return choose_media_type(accept, modalities[0])
    return choose_among([MSGPACK], accept, of="more than one image")


def frames_response(rendered: RenderedFrames, media_type: str, *, t_us: int) -> Response:
    """The answer that carries all frames of one instant; one alone also as an image file."""
    if media_type != MSGPACK:
        return frame_response(rendered, media_type)
    view = {"t_us": t_us, "frames": [frame.fields for frame in rendered.frames]}
    view["timing"] = rendered.timing_ms
    headers = {"Vary": "Accept", "Cache-Control": "no-store"}
    return Response(encode_message(view), media_type=MSGPACK, headers=headers)


def frame_response(
    rendered: RenderedFrames, media_type: str, *, revision: int | None = None
) -> Response:
    """The answer that carries the first frame.

    msgpack holds the whole frame (pose, intrinsics, raw pixels) as on the drive socket; image
    files carry the milliseconds by stage in ``Server-Timing`` as well.
    """
    frame = rendered.frames[0]
    content: bytes = bytes(frame.data)
    if media_type == MSGPACK:
        content = encode_message(frame.fields)
    timing = ", ".join(f"{stage};dur={ms:.2f}" for stage, ms in rendered.timing_ms.items())
    headers = {"Server-Timing": timing, "Vary": "Accept", "Cache-Control": "no-store"}
    if revision is not None:
        headers["X-Real2Sim-Revision"] = etag(revision)
    return Response(content, media_type=media_type, headers=headers)
