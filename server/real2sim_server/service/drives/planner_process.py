"""A planner of the SDK in a process of its own, which drives over the socket like any client."""

from __future__ import annotations

import json

from real2sim_proto.jobs import DriveRequest

from ..jobs.command_process import CommandProcess
from ..sessions.session import Session

EPISODE_STEPS = 100_000
"""More than any recording has: it ends with its episode."""

OF_THE_PLANNER = {
    *("sensors", "lidars", "radars", "action", "privileged"),
    *("seed", "dt_us", "warmup_us"),
}
"""Of a reset: what a planner says itself, and what the command has options of its own for."""


async def start_planner(
    request: DriveRequest, session: Session, *, url: str, token: str
) -> CommandProcess:
    """Start `real2sim drive --session`.

    Args:
        request: which planner, and for how long.
        session: that it drives, reset as it was made.
        url: of the worker.
        token: of the session; handed over in the environment, which other users cannot read.
    """
    environment = {"REAL2SIM_SESSION_TOKEN": token}
    return await CommandProcess.run(_command(request, session, url), environment=environment)


def _command(request: DriveRequest, session: Session, url: str) -> list[str]:
    spec = session.spec
    reset = spec.model_dump(mode="json", exclude_unset=True, exclude=OF_THE_PLANNER)
    options = {
        "--session": session.session_id,
        "--planner": str(request.planner),
        "--steps": str(request.steps or EPISODE_STEPS),
        "--seed": str(spec.seed),
        "--dt-us": str(spec.dt_us),
        "--warmup-us": str(spec.warmup_us),
        "--reset": json.dumps(reset),
        "--url": url,
    }
    given = [text for option in options.items() for text in option]
    return ["drive", *given]
