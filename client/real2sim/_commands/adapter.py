"""``real2sim adapter`` renders for other simulators; ``real2sim ros2`` runs a ROS 2 node."""

from __future__ import annotations

import logging
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import DEFAULT_URL, Timeout, Token, Url, connected, json_object

if TYPE_CHECKING:
    from ..renderers.linked_scene import SceneLink


app = typer.Typer()
adapters = typer.Typer(no_args_is_help=True, help="Render images for other simulators.")
app.add_typer(adapters, name="adapter")

Host = Annotated[str, typer.Option(help="Address to listen on.")]
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
        bool, typer.Option("--strict", help="Refuse objects that are not in the scene.")
    ] = False,
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 picks a free one.")] = 8080,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Serve AlpaSim's `SensorsimService`; needs `pip install 'real2sim[alpasim]'`."""
    from ..renderers.alpasim import AlpasimRenderer

    with connected(url, token, timeout) as client:
        renderer = AlpasimRenderer(client, links=_read(links), strict=strict)
        client.server()
        listening = renderer.start(f"{host}:{port}")
        _serve(f"AlpaSim's renderer interface at {host}:{listening}, pictures from {url}")
        renderer.stop()


@adapters.command("neuroncap-renderer")
def neuroncap_renderer(
    *,
    scene: Annotated[str, typer.Option(help="Name of a scene or of a link.")],
    links: Links = None,
    host: Host = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 picks a free one.")] = 8000,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Serve NeuroNCAP's renderer API."""
    from ..renderers.linked_scene import SceneLink
    from ..renderers.neuroncap import NeuroNcapRenderer

    link = _read(links).get(scene, SceneLink(scene=scene))
    with connected(url, token, timeout) as client:
        renderer = NeuroNcapRenderer(client, link)
        listening = renderer.start(host, port)
        _serve(f"NeuroNCAP's renderer interface at {host}:{listening}, pictures from {url}")
        renderer.stop()


def _read(links: Path | None) -> dict[str, SceneLink]:
    from ..renderers.linked_scene import read_links

    return {} if links is None else read_links(links)


def _serve(what: str) -> None:
    """Print the address and any warnings until Ctrl+C or SIGTERM."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    typer.echo(what)
    # On some platforms, a wait without a timeout blocks signals.
    while not stop.wait(1.0):
        pass


# ROS 2.


@app.command("ros2")
def ros2(
    *,
    scene: Annotated[str | None, typer.Option(help="Name of a scene.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Id of a scenario.")] = None,
    commands: Annotated[
        str,
        typer.Option(
            help="Command topic: ackermann (/ackermann_cmd), twist (/cmd_vel) or path (/plan)."
        ),
    ] = "ackermann",
    cameras: Annotated[str, typer.Option(help="Comma-separated camera names, or 'all'.")] = "",
    width: Annotated[
        int | None, typer.Option(min=16, help="Image width [px]; default: as recorded.")
    ] = None,
    real_time: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="Run at this multiple of wall-clock time with the latest command. "
            "Without it every observation waits for a command.",
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Maximum steps; default: until the episode ends.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the episode.")] = 0,
    dt_us: Annotated[int, typer.Option(help="Time step [us].")] = 50_000,
    reset: Annotated[
        str | None, typer.Option(metavar="JSON", help="Further reset options.")
    ] = None,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Run a session as a ROS 2 node; needs ROS 2 with `rclpy`."""
    from ..ros2.bridge import COMMANDS, Ros2Bridge, RosNode

    if (scene is None) == (scenario is None):
        raise typer.BadParameter("give exactly one of --scene and --scenario")
    if commands not in COMMANDS:
        raise typer.BadParameter(f"--commands is {commands!r}, not {', '.join(COMMANDS)}")
    options = json_object("--reset", reset) | {"seed": seed, "dt_us": dt_us}
    node = RosNode()
    try:
        with (
            connected(url, token, timeout) as client,
            client.session(scene=scene, scenario=scenario) as session,
        ):
            names = session.cameras if cameras == "all" else [c for c in cameras.split(",") if c]
            bridge = Ros2Bridge(
                session, node, commands=commands, real_time=real_time, report=_report
            )
            sensors = [{"camera": name, "width": width} for name in names]
            last = bridge.run(sensors=sensors, steps=steps, **options)
    finally:
        node.close()
    typer.echo(f"{last.step} steps; ended: {last.reason or 'here'}")


def _report(sentence: str) -> None:
    typer.echo(sentence, err=True)
