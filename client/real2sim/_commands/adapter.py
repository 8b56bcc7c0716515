"""``real2sim adapter``: a worker's pictures for other simulators."""

from __future__ import annotations

import logging
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import DEFAULT_URL, Timeout, Token, Url, connected

if TYPE_CHECKING:
    from real2sim.renderers.scene_link import SceneLink

app = typer.Typer()
adapters = typer.Typer(
    no_args_is_help=True, help="Let another simulator drive, and draw what its cameras see."
)
app.add_typer(adapters, name="adapter")

Host = Annotated[str, typer.Option(help="Address to listen at.")]
Links = Annotated[
    Path | None,
    typer.Option(
        help="JSON file of the simulator's scenes: SCENE_ID to scene, T_world_theirs, offset_us, "
        "cameras, objects."
    ),
]


@adapters.command("alpasim-renderer")
def alpasim_renderer(
    *,
    links: Links = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Refuse objects that a scene lacks.")
    ] = False,
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any.")] = 8080,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Serve AlpaSim's `SensorsimService`; needs `pip install 'real2sim[alpasim]'`."""
    from real2sim.renderers.alpasim import AlpasimRenderer

    with connected(url, token, timeout) as client:
        renderer = AlpasimRenderer(client, links=_read(links), strict=strict)
        client.server()
        listening = renderer.start(f"{host}:{port}")
        _serve(f"AlpaSim's renderer interface at {host}:{listening}, pictures from {url}")
        renderer.stop()


@adapters.command("neuroncap-renderer")
def neuroncap_renderer(
    *,
    scene: Annotated[str, typer.Option(help="Name of a scene, or of one of the links.")],
    links: Links = None,
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any.")] = 8000,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Serve NeuroNCAP's renderer: alive, get_actors, update_actors, render_image, start_time."""
    from real2sim.renderers.neuroncap import NeuroNcapRenderer
    from real2sim.renderers.scene_link import SceneLink

    link = _read(links).get(scene, SceneLink(scene=scene))
    with connected(url, token, timeout) as client:
        renderer = NeuroNcapRenderer(client, link)
        listening = renderer.start(host, port)
        _serve(f"NeuroNCAP's renderer interface at {host}:{listening}, pictures from {url}")
        renderer.stop()


def _read(links: Path | None) -> dict[str, SceneLink]:
    from real2sim.renderers.scene_link import read_links

    return {} if links is None else read_links(links)


def _serve(what: str) -> None:
    """Say what is served, and warnings as they come, until Ctrl+C or SIGTERM."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    typer.echo(what)
    # Without a timeout no signal would be seen on every platform.
    while not stop.wait(1.0):
        pass
