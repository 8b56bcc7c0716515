"""``real2sim demo``: take a street, serve it, edit it over REST, drive it over WebSocket."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from real2sim import Client, ReplyTimeoutError, connect
from real2sim.planners import FollowRoute

from ..console import StatusLine, console, print_figures, write_json
from ..render.images import write_png
from ..scene.io import DEMO_SCENE as SCENE
from .edits import StreetEdits, edit_street
from .pictures import draw_map
from .worker import starting_worker

if TYPE_CHECKING:
    from .drive import FilmedDrive

CAMERAS = ("front_left", "front", "front_right")
STEP_US = 100_000
QUIET_S, POLL_S, WARM_UP_S = 5.0, 1.0, 600.0


def run(*, out: Path, steps: int, from_log: bool, leave_serving: bool) -> None:
    """Run the whole demo; results lie below ``out`` afterwards.

    Args:
        out: folder; what an earlier demo left there is replaced.
        steps: clock steps of 0.1 s to drive; the shipped street ends after 100.
        from_log: record a drive and reconstruct it without training, rather than unpack the
            trained street that is shipped.
        leave_serving: keep the worker up until Ctrl-C, and print what to try next.
    """
    clock = StageTimer()
    scenes = _clear(out)
    with starting_worker(scenes=scenes, data=out / "worker", log_file=out / "worker.log") as worker:
        # Loading libraries and unpacking take as long as the worker takes to start.
        _prepare_street(out, scenes, steps, clock, from_log=from_log)
        from .drive import drive_through

        with connect(worker.url) as client:
            with clock("start the worker"):
                worker.wait_listening()
                wait_ready(client)
                client.scenes.load(SCENE)
            with clock("edit over REST"):
                scenario = client.scenarios.create(scene=SCENE, name="demo")
                edits = edit_street(scenario, client.scenes.get(SCENE), camera="front")
            with clock("drive over WebSocket"):
                session = client.session(scenario=scenario.scenario_id)
                drive = drive_through(
                    session,
                    FollowRoute(speed=8.0),
                    cameras=CAMERAS,
                    steps=steps,
                    dt_us=STEP_US,
                    video_path=out / "drive.webm",
                )
        with clock("leave pictures"):
            _leave_pictures(out, edits, drive)
        figures = _summary(edits, drive, clock)
        write_json(out / "summary.json", figures)
        _report(out, drive, clock)
        if leave_serving:
            _keep_serving(worker.url, scenario.scenario_id)


class StageTimer:
    """Wall seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Measure the block as ``stage``, and say on the console that it runs."""
        start = time.perf_counter()
        with console.status(stage) if console.is_terminal else nullcontext():
            yield
        self.seconds[stage] = time.perf_counter() - start


def wait_ready(client: Client) -> None:
    """Wait for the worker, and say what it does where that takes long.

    Raises:
        ReplyTimeoutError: it is not ready after ten minutes.
    """
    deadline = time.monotonic() + WARM_UP_S
    line, timeout = StatusLine(), QUIET_S
    try:
        while True:
            try:
                client.wait_ready(timeout=timeout)
                return
            except ReplyTimeoutError as error:
                if time.monotonic() > deadline:
                    raise
                line.show(f"the worker is not ready yet: {error.hint}")
            timeout = POLL_S
    finally:
        line.end()


def _clear(out: Path) -> Path:
    """Remove what an earlier demo left; the folder for scenes."""
    for stale in ("log", "scenes", "worker"):
        shutil.rmtree(out / stale, ignore_errors=True)
    scenes = out / "scenes"
    scenes.mkdir(parents=True)
    return scenes


def _prepare_street(
    out: Path, scenes: Path, steps: int, clock: StageTimer, *, from_log: bool
) -> None:
    from .street import UNTRAINED_HZ, build_street, record_street, unpack_street

    if not from_log:
        with clock("unpack the street"):
            unpack_street(scenes, SCENE)
        return
    log = out / "log"
    with clock("record a synthetic drive"):
        record_street(log, duration_s=(steps + 2) * STEP_US * 1e-6, hz=UNTRAINED_HZ)
    with clock("reconstruct it"):
        build_street(log, scenes, SCENE)


def _leave_pictures(out: Path, edits: StreetEdits, drive: FilmedDrive) -> None:
    write_png(out / "edit_before.png", edits.before)
    write_png(out / "edit_after.png", edits.after)
    for step, picture in drive.stills.items():
        write_png(out / f"drive_{step:03d}.png", picture)
    draw_map(out / "map.png", logged=edits.logged, driven=drive.path, boxes=edits.footprints)


def _summary(edits: StreetEdits, drive: FilmedDrive, clock: StageTimer) -> dict[str, object]:
    return {
        "scene": SCENE,
        "gaussians": edits.gaussians,
        "objects": len(edits.footprints),
        "moved": edits.moved,
        "duplicated": edits.duplicated,
        "cameras": list(CAMERAS),
        "stages_s": clock.seconds,
        "episode": drive.summary.to_dict(),
    }


def _report(out: Path, drive: FilmedDrive, clock: StageTimer) -> None:
    episode = drive.summary
    figures: dict[str, object] = {f"{k} [s]": v for k, v in clock.seconds.items()}
    figures |= {
        "steps driven": episode.steps,
        "distance [m]": episode.distance,
        "ended by": episode.reason or "steps done",
        "steps per second": episode.steps_per_second,
    }
    figures |= {f"{name} p50 [ms]": times.p50 for name, times in episode.stages.items()}
    print_figures("demo", figures)
    console.print(
        f"in {out}: drive.webm, edit_before.png, edit_after.png, map.png, summary.json",
        highlight=False,
    )


def _keep_serving(url: str, scenario_id: str) -> None:
    preview = f"{url}/v1/scenarios/{scenario_id}/preview?camera=front"
    operations = '{"operations": [{"op": "rotate", "object_id": "car_1", "angle": 0.26}]}'
    console.print(
        f"\nthe worker stays up at {url} until Ctrl-C; next, in another terminal:\n\n"
        f"  curl '{preview}' -o now.jpg\n"
        f"  curl -X POST {url}/v1/scenarios/{scenario_id}/operations \\\n"
        f"       -H 'Content-Type: application/json' -d '{operations}'\n"
        f"  real2sim drive --url {url} --scenario {scenario_id} --steps 50 --out out/drive\n",
        highlight=False,
        soft_wrap=True,
    )
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        console.print("stopped")
