"""The studio: static files, the same for everybody; what it shows needs the token."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import RedirectResponse, Response

from real2sim_proto import ErrorCode

from ..http.problems import ServiceError

FOLDER = Path(__file__).parents[1] / "ui"
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self' ws: wss:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing from elsewhere: the studio works offline, and what is no part of it cannot run."""

router = APIRouter(include_in_schema=False)


@router.get("/")
@router.get("/ui")
async def entry() -> Response:
    """To the studio; relative links need the slash."""
    return RedirectResponse("/ui/")


@router.get("/ui/{name:path}")
async def file(name: str) -> Response:
    """One file of the studio. Raises ServiceError: NOT_FOUND."""
    path = STUDIO.get(name or "index.html")
    if path is None:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"the studio has no file {name!r}",
            hint="open /ui/",
        )
    headers = {
        "Cache-Control": "no-cache",
        "Content-Security-Policy": POLICY,
    }
    return Response(path.read_bytes(), media_type=MEDIA_TYPES[path.suffix], headers=headers)


# Listed once: a path of a request is looked up, never joined to a folder.
STUDIO = {p.name: p for p in sorted(FOLDER.iterdir()) if p.suffix in MEDIA_TYPES}
"""Files of the studio by name."""
