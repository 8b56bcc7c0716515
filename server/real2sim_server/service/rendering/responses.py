"""Frames as HTTP answers, in the form that the client accepts."""

from __future__ import annotations

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


def frame_response(
    rendered: RenderedFrames, media_type: str, *, revision: int | None = None
) -> Response:
    """The answer that carries the first frame.

    msgpack holds the whole frame (pose, intrinsics, raw pixels) as on the drive socket; image
    files carry the milliseconds by stage in ``Server-Timing`` as well.
    """
    frame = rendered.frames[0]
    content: bytes = bytes(frame.data)
    if media_type == "application/msgpack":
        content = encode_message(frame.fields)
    timing = ", ".join(f"{stage};dur={ms:.2f}" for stage, ms in rendered.timing_ms.items())
    headers = {"Server-Timing": timing, "Vary": "Accept", "Cache-Control": "no-store"}
    if revision is not None:
        headers["X-Real2Sim-Revision"] = etag(revision)
    return Response(content, media_type=media_type, headers=headers)
