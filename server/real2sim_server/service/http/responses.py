"""Answers: models as JSON, and the media type that a client accepts."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence

from fastapi import Response
from pydantic import BaseModel

from real2sim_proto import ErrorCode

from .problems import ServiceError


def choose_among(offered: Sequence[str], accept: str | None, *, of: str) -> str:
    """The one of ``offered``, best first, that the client likes best.

    Raises:
        ServiceError: NOT_ACCEPTABLE when it likes none; ``of`` says of what.
    """
    ranked = [(_quality(accept or "*/*", media_type), media_type) for media_type in offered]
    best = max(quality for quality, _ in ranked)
    if best <= 0:
        raise ServiceError(
            ErrorCode.NOT_ACCEPTABLE,
            f"Accept {accept!r} allows none of {', '.join(offered)} for {of}",
            hint="leave Accept out for " + offered[0],
        )
    return next(media_type for quality, media_type in ranked if quality == best)


def info_response(
    body: BaseModel, *, status: int = 200, headers: Mapping[str, str] | None = None
) -> Response:
    """A model that was made here and needs no second validation."""
    return Response(
        body.model_dump_json(),
        status_code=status,
        media_type="application/json",
        headers=dict(headers or {}),
    )


async def large_response(
    build: Callable[[], BaseModel],
    *,
    status: int = 200,
    headers: Mapping[str, str] | None = None,
) -> Response:
    """The answer for a model with many objects, built and written on another thread.

    It is written in pieces: one call for all of a scene's trajectories would keep every thread
    waiting for the interpreter for tens of milliseconds, the event loop too.
    """
    content = await asyncio.to_thread(lambda: json_in_pieces(build()))
    return Response(content, status, dict(headers or {}), "application/json")


def json_in_pieces(model: BaseModel) -> str:
    """The same JSON value as ``model_dump_json``, one call for each model in a list."""
    lists = {
        name: value
        for name, value in model
        if isinstance(value, list) and value and isinstance(value[0], BaseModel)
    }
    text = model.model_dump_json(exclude=set(lists))
    for name, items in lists.items():
        separator = "" if text == "{}" else ","
        joined = ",".join(map(json_in_pieces, items))
        text = f'{text[:-1]}{separator}"{name}":[{joined}]}}'
    return text


def etag(revision: int) -> str:
    """Value of ETag and If-Match for a revision."""
    return f'"r{revision}"'


def _quality(accept: str, media_type: str) -> float:
    """How much ``accept`` likes ``media_type``: the q of the most specific range that fits."""
    kind = media_type.split("/", maxsplit=1)[0]
    specificity = {media_type: 3, f"{kind}/*": 2, "*/*": 1}
    best, quality = 0, 0.0
    for part in accept.lower().split(","):
        name, *parameters = (piece.strip() for piece in part.split(";"))
        rank = specificity.get(name, 0)
        if rank > best:
            best, quality = rank, _q(parameters)
    return quality


def _q(parameters: list[str]) -> float:
    for parameter in parameters:
        if parameter.startswith("q="):
            try:
                return min(1.0, max(0.0, float(parameter[2:])))
            except ValueError:
                return 0.0
    return 1.0
