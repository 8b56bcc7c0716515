"""The studio: static files, the same for everybody; what it shows needs the token."""

from __future__ import annotations

import base64
import hashlib
import re
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
IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def policy_of(page: str) -> str:
    """Nothing from elsewhere: the studio works offline, and what is no part of it cannot run.

    The map of the page's vendored modules is allowed by its hash. The renderer of Gaussians sorts
    in WebAssembly that it carries as ``data:``, on a worker that it makes of a ``blob:``.
    """
    maps = IMPORT_MAP.findall(page)
    hashes = (base64.b64encode(hashlib.sha256(m.encode()).digest()).decode() for m in maps)
    allowed = " ".join(f"'sha256-{h}'" for h in hashes)
    return (
        f"default-src 'none'; script-src 'self' 'wasm-unsafe-eval' {allowed}; style-src 'self'; "
        "img-src 'self' blob: data:; connect-src 'self' ws: wss: data:; worker-src blob:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


POLICY = policy_of((FOLDER / "index.html").read_text(encoding="utf-8"))

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
        # What is vendored has its version in its path.
        "Cache-Control": "public, max-age=31536000, immutable"
        if name.startswith("vendor/")
        else "no-cache",
        "Content-Security-Policy": POLICY,
    }
    return Response(path.read_bytes(), media_type=MEDIA_TYPES[path.suffix], headers=headers)


# Listed once: a path of a request is looked up, never joined to a folder.
STUDIO = {
    p.relative_to(FOLDER).as_posix(): p
    for p in sorted(FOLDER.rglob("*"))
    if p.suffix in MEDIA_TYPES
}
"""Files of the studio by path."""
