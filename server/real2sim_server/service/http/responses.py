"""Answers: models as JSON, the media type a client accepts, event streams, headers of all."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence

from fastapi import Response
from pydantic import BaseModel
from starlette.datastructures import MutableHeaders

from real2sim_proto import ErrorCode

from .problems import ServiceError

NOTHING = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
"""Content security policy of answers that are no pages."""

SECURITY_HEADERS = {
    "Content-Security-Policy": NOTHING,
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def secure(headers: MutableHeaders) -> None:
    """Add what is missing; a page brings a policy of its own."""
    for name, value in SECURITY_HEADERS.items():
        headers.setdefault(name, value)


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


HEARTBEAT_S = 10.0
"""Comments this far apart keep proxies from closing a stream on which nothing happens."""


async def event_stream(events: AsyncIterator[tuple[int, str, str]]) -> AsyncIterator[bytes]:
    """The bytes of (id, name, data without line breaks), with heartbeats in between."""
    source = aiter(events)
    pending: asyncio.Future[tuple[int, str, str]] | None = None
    try:
        while True:
            pending = pending or asyncio.ensure_future(anext(source))
            done, _ = await asyncio.wait({pending}, timeout=HEARTBEAT_S)
            if not done:
                yield b": still here\n\n"
                continue
            try:
                number, name, data = pending.result()
            except StopAsyncIteration:
                return
            pending = None
            yield f"id: {number}\nevent: {name}\ndata: {data}\n\n".encode()
    finally:
        if pending is not None:
            pending.cancel()
