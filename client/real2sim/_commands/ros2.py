"""``real2sim ros2``: a session as a ROS 2 node."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import DEFAULT_URL, Timeout, Token, Url, connected, json_object

app = typer.Typer()


@app.command("ros2")
def ros2(
    *,
    scene: Annotated[str | None, typer.Option(help="Name of a scene.")] = None,
    scenario: Annotated[str | None, typer.Option(help="Id of a scenario.")] = None,
    commands: Annotated[
        str,
        typer.Option(
            help="What drives: 'ackermann' (/ackermann_cmd), 'twist' (/cmd_vel) or 'path' (/plan)."
        ),
    ] = "ackermann",
    cameras: Annotated[str, typer.Option(help="Names, with commas between; 'all'.")] = "",
    width: Annotated[
        int | None, typer.Option(min=16, help="Pixels of their images; default: recorded.")
    ] = None,
    real_time: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="The clock goes on at this multiple of wall-clock time, under the newest command. "
            "Without it every observation waits for a command.",
        ),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Default: to the episode's end.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the episode.")] = 0,
    dt_us: Annotated[int, typer.Option(help="Clock step.")] = 50_000,
    reset: Annotated[
        str | None, typer.Option(metavar="JSON", help="Other options of reset.")
    ] = None,
    url: Url = DEFAULT_URL,
    token: Token = None,
    timeout: Timeout = 60.0,
) -> None:
    """Publish what a session shows, and drive it by messages; needs ROS 2 with `rclpy`."""
    from real2sim.ros2.bridge import COMMANDS, Ros2Bridge
    from real2sim.ros2.node import RosNode

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
