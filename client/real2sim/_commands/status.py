"""``real2sim status``: what worker is there, and does it take sessions?"""

from __future__ import annotations

import typer

from .options import DEFAULT_URL, JsonFile, Timeout, Token, Url, connected, console, write_json

app = typer.Typer()


@app.command()
def status(
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 10.0,
    json_file: JsonFile = None,
) -> None:
    """Show a worker's version, device, limits and readiness; exit code 1 when not ready."""
    with connected(url, token, timeout) as client:
        info, readiness = client.server(), client.readiness()
    if json_file is not None:
        write_json(
            json_file,
            {"server": info.model_dump(mode="json"), "readiness": readiness.model_dump()},
        )
    else:
        state = "ready" if readiness.ready else "not ready: " + "; ".join(readiness.reasons)
        out = console()
        out.print(f"worker [bold]{info.worker_id}[/bold] at {url}: {state}")
        out.print(f"version {info.version}, protocol {info.protocol_version}")
        device = info.device
        out.print(
            f"renders with {device.backend} on {device.device}, {device.threads} threads "
            f"({device.reason})",
            highlight=False,
        )
        limits = ", ".join(f"{name} {value}" for name, value in info.limits.model_dump().items())
        out.print(f"limits: {limits}", highlight=False)
    if not readiness.ready:
        raise typer.Exit(1)
