"""Makes every picture of README.md and docs anew, by the commands that the text shows.

Run it from the root of the repository, in the environment of ``make demo``, with playwright and a
Chromium on the PATH (or in ``CHROMIUM``) for the studio::

    .venv/bin/python docs/images/make.py [--work out/pictures] [NAME ...]

NAME is one of demo, film, scenario, studio, wall, pair, drop, crashes, ground, lenses, cars,
people, jam; without one, all but jam are made. It takes about twenty minutes on two cores. ``jam``
trains for another twenty, on the KITTI drive whose folder ``KITTI_LOG`` names.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import real2sim
from real2sim.planners import FollowRoute
from real2sim_proto.operations import Delete, Duplicate, Operation, Rotate, Translate
from real2sim_server.demo.run import SCENE, worker_process
from real2sim_server.demo.street import DURATION_S, TRAINING_HZ, record_street, unpack_street
from real2sim_server.edit import ScenarioState, apply_operations, instances_at, posed_instances
from real2sim_server.geometry import apply_transform
from real2sim_server.render import render_cameras
from real2sim_server.scene import Camera, Fisheye, Scene, Shutter
from real2sim_server.scene.io import load_scene
from real2sim_server.synthetic import SyntheticConfig, SyntheticLog, generate_log

HERE = Path(__file__).parent
EDITS = [
    {
        "op": "translate",
        "object_id": "car_7",
        "x": 4,
        "y": 3.4,
        "frame": "object",
        "snap": True,
        "time_range": {"start_us": 4_000_000},
    },
    {
        "op": "duplicate",
        "object_id": "car_6",
        "new_id": "twin",
        "x": -9.4,
        "y": 0.4,
        "frame": "object",
        "snap": True,
    },
    {"op": "rotate", "object_id": "car_6", "angle": 0.2618},
]
"""Of docs/rest.md."""
SHOWN_US = 5_250_000
LENSES_US = 5_300_000
CARS_US = 6_600_000
IN_THE_LANE = {"op": "translate", "object_id": "car_6", "y": 3.0, "frame": "object", "snap": True}
"""Puts a parked car before the van that drives ahead, for the studio's run of physics."""


def main() -> None:
    """Make the pictures that are named."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--work", type=Path, default=Path("out/pictures"))
    everything = [name for name in PICTURES if name != "jam"]
    parser.add_argument("names", nargs="*", default=everything)
    given = parser.parse_args()
    scenes = given.work / "scenes"
    shutil.rmtree(scenes, ignore_errors=True)
    unpack_street(scenes, SCENE)
    for name in given.names:
        PICTURES[name](given.work, scenes)


def demo(work: Path, _: Path) -> None:
    """``edit.jpg``, ``drive.jpg`` and ``map.png`` from what ``real2sim demo`` leaves."""
    command("demo", "--out", work / "demo")
    before, after = (read(work / "demo" / f"edit_{name}.png") for name in ("before", "after"))
    gap = np.full((before.shape[0], 8, 3), 255, np.uint8)
    save("edit.jpg", np.concatenate([before, gap, after], axis=1), width=1200)
    save("drive.jpg", read(work / "demo" / "drive_050.png"), width=1200)
    save("map.png", read(work / "demo" / "map.png"), width=1000)


def film(work: Path, scenes: Path) -> None:
    """``film.webp``, the README's moving picture: an edit, a drive through it, a crash."""
    frames: list[tuple[np.ndarray, int]] = []

    def show(image: np.ndarray, caption: str, ms: int) -> None:
        image = cv2.resize(image, (480, 320), interpolation=cv2.INTER_AREA)
        cv2.rectangle(image, (0, 296), (480, 320), (44, 36, 32), -1)
        cv2.putText(
            image, caption, (10, 312), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235,) * 3, 1, cv2.LINE_AA
        )
        frames.append((image[..., ::-1], ms))

    with worker(work, scenes) as (client, _):
        edited = client.scenarios.create(scene=SCENE, name="film")
        view = {"camera": "front", "t_us": SHOWN_US, "width": 480}
        for caption, operations in (("the recorded street", []), ("edit it ...", EDITS)):
            for operation in operations or [None]:
                if operation is not None:
                    edited.apply([operation])
                show(edited.preview(**view).array[..., ::-1], caption, 1000)
        planner = FollowRoute(speed=8.0)
        with client.session(scenario=edited) as session:
            obs = session.reset(seed=0, sensors=["front"], privileged=True)
            planner.reset(obs)
            while not obs.over and obs.step < 72:
                obs = session.step(planner.plan(obs))
                if obs.step % 2 == 0:
                    show(
                        obs.image("front")[..., ::-1], "... let a policy drive through it ...", 100
                    )
    crash = work / "t_bone"
    simulated = ("simulate", scenes / SCENE, "--out", crash, "--experiment", "t_bone")
    command(*simulated, "--max-particles", "8000", "--no-film")
    command("film", scenes / SCENE, crash, "--view", "near", "--slow", "4")
    video = cv2.VideoCapture(str(crash / "film.mp4"))
    shown = []
    while (read_one := video.read())[0]:
        shown.append(read_one[1])
    for image in shown[:: max(1, len(shown) // 40)]:
        cut = image.shape[0] * 3 // 2
        left = max(0, (image.shape[1] - cut) // 2)
        show(image[:, left : left + cut], "... or crash its vehicles", 100)
    first, *others = (Image.fromarray(image) for image, _ in frames)
    durations = [ms for _, ms in frames]
    first.save(
        HERE / "film.webp",
        save_all=True,
        append_images=others,
        duration=durations,
        loop=0,
        quality=60,
        method=6,
    )
    print(HERE / "film.webp")


def scenario(work: Path, scenes: Path) -> None:
    """``scenario_before.jpg`` and ``scenario_after.jpg``: the three edits of docs/rest.md."""
    with worker(work, scenes) as (client, _):
        edited = client.scenarios.create(scene=SCENE, name="cut-in")
        view = {"camera": "front", "t_us": SHOWN_US, "width": 960, "codec": "png"}
        for name, operations in (("before", []), ("after", EDITS)):
            for operation in operations:
                edited.apply([operation])
            edited.preview(**view).save(work / f"{name}.png")
            save(f"scenario_{name}.jpg", read(work / f"{name}.png"), width=960)


def studio(work: Path, scenes: Path) -> None:
    """``studio.jpg``: a van that has run into a car, on the page of physics."""
    from playwright.sync_api import sync_playwright

    with worker(work, scenes) as (client, url), sync_playwright() as playwright:
        edited = client.scenarios.create(scene=SCENE, name="street edit")
        for operation in (*EDITS[:2], IN_THE_LANE):
            edited.apply([operation])
        end_us = SHOWN_US + 1_000_000
        job = edited.simulate(start_us=SHOWN_US, end_us=end_us, objects=["van_0", "car_6"])
        job = job.wait(timeout=900.0)
        browser = playwright.chromium.launch(
            executable_path=os.environ.get("CHROMIUM") or shutil.which("chromium"),
            args=["--no-sandbox", "--disable-gpu", "--disable-background-networking"],
        )
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        link = f"scenario={edited.scenario_id}&camera=front&t={end_us - 150_000}&selected=van_0"
        page.goto(f"{url}/ui/?{link}&run={job.info.job_id}")
        page.wait_for_selector("body[data-ready=yes]", timeout=120_000)
        page.click("button[data-tab=physics]")
        page.click("#next")  # the curves are drawn when the time changes on the open page
        page.wait_for_timeout(8_000)
        page.screenshot(path=work / "studio.png")
        browser.close()
    save("studio.jpg", read(work / "studio.png"), width=1440)


def wall(work: Path, scenes: Path) -> None:
    """``wall.jpg``: a van against a wall at 15.6 m/s."""
    experiment(work, scenes, "wall", "--preset", "vehicle", "--speed", "15.6")


def pair(work: Path, scenes: Path) -> None:
    """``pair.jpg``: a van into a standing van at 3.5 m/s."""
    experiment(work, scenes, "pair", "--preset", "vehicle")


def drop(work: Path, scenes: Path) -> None:
    """``drop.jpg``: vehicles dropped onto the road."""
    experiment(work, scenes, "drop", "--preset", "paper")


def crashes(work: Path, scenes: Path) -> None:
    """``crashes.jpg``: frontal, T-bone, pole and roof, each in a row of stills."""
    rows = []
    for name in ("frontal", "t_bone", "pole", "roof"):
        folder = work / name
        simulated = ("simulate", scenes / SCENE, "--out", folder, "--experiment", name)
        command(*simulated, "--max-particles", "8000", "--no-film")
        command("film", scenes / SCENE, folder, "--view", "near")
        rows.append(read(folder / "strip.png"))
    save("crashes.jpg", np.concatenate(rows), width=1600)


def experiment(work: Path, scenes: Path, name: str, *options: str) -> None:
    """The strip of stills that ``real2sim simulate`` leaves."""
    command("simulate", scenes / SCENE, "--out", work / name, "--experiment", name, *options)
    save(f"{name}.jpg", read(work / name / "strip.png"), width=1800)


def ground(work: Path, scenes: Path) -> None:
    """``ground.jpg``: the road from LiDAR and from Gaussians."""
    log, picture = work / "log", work / "ground.png"
    if not log.exists():
        record_street(log, duration_s=DURATION_S, hz=TRAINING_HZ)
    command("ground", scenes / SCENE, "--log", log, "--picture", picture)
    save("ground.jpg", read(picture), width=1100)


def lenses(_: Path, scenes: Path) -> None:
    """``lenses.jpg``: a fisheye of 190 degrees, and a rolling shutter at 30 m/s."""
    scene = load_scene(scenes / SCENE)
    front, left = scene.rig["front"].resized(640), scene.rig["front_left"].resized(640)
    focal = 320 / np.radians(95)
    K = np.array([[focal, 0, 320], [0, focal, front.height / 2], [0, 0, 1]])
    eye = replace(front, K=K, lens=Fisheye((0.02, -0.01, 0.001, 0.0), np.radians(95)))
    rolling = replace(left, shutter=Shutter("top_to_bottom", 60_000))
    vehicle = scene.ego.transform(LENSES_US)
    fast = np.concatenate([vehicle[:3, 0] * 30, np.zeros(3)])
    instances = posed_instances(scene, LENSES_US, {})
    frames = render_cameras(
        instances, [eye, rolling], vehicle, sky=scene.sky, backend="cpu", twist=fast
    )
    gap = np.full((front.height, 6, 3), 255, np.uint8)
    pictures = [frame.rgb[..., ::-1] for frame in frames]
    save("lenses.jpg", np.concatenate([pictures[0], gap, pictures[1]], axis=1), width=1286)


def cars(_: Path, scenes: Path) -> None:
    """``cars.jpg``: a parked car of the demo's street in all kinds of edits."""
    rows = {
        "as recorded": [],
        "turned by 35 degrees": [Rotate(object_id="car_6", angle=np.radians(35))],
        "turned by 90 degrees": [Rotate(object_id="car_6", angle=np.radians(90))],
        "moved": [Translate(object_id="car_6", x=2, y=3.0, frame="object", snap=True)],
        "duplicated": [Duplicate(object_id="car_6", x=6.5, frame="object", snap=True)],
        "the van ahead deleted": [Delete(object_id="van_0")],
    }
    edits("cars.jpg", load_scene(scenes / SCENE), CARS_US, rows, rows_shown=slice(180, 480))


def people(_: Path, __: Path) -> None:
    """``people.jpg``: a stride, and who else is on a synthetic street."""
    log = generate_log(SyntheticConfig(seed=3, frames=40, samples=3, pedestrians=10, cyclists=2))
    first = int(log.people(0).tracks[0])
    stride = [(first + 7, 1_000_000 + k * 150_000, -1.5) for k in range(8)]
    others = [(first + i, 1_500_000, -0.9 + 0.5 * (i % 4)) for i in (0, 1, 2, 3, 6)]
    others += [(first + 10, 1_500_000, 0.5), (first + 11, 1_500_000, 1.4)]
    others += [(first + 11, 1_500_000, 2.6)]
    rows = [[portrait(log, *view) for view in row] for row in (stride, others)]
    image = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    save("people.jpg", image, width=1280)


def portrait(log: SyntheticLog, track: int, t_us: int, yaw: float) -> np.ndarray:
    """Somebody from a side, BGR [300, 200, 3]."""
    away = np.array([np.cos(yaw), np.sin(yaw), 0.08])
    right = np.cross(-away, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(-away, right), -away], axis=1)
    pose[:3, 3] = 3.6 * away
    K = np.array([[340.0, 0, 100], [0, 340, 150], [0, 0, 1]])
    T_world_camera = log.tracks[track].trajectory.transform(t_us) @ pose
    return log.render(T_world_camera, K, 200, 300, t_us)[0][..., ::-1]


def jam(work: Path, _: Path) -> None:
    """``jam.jpg``: the car ahead in a KITTI drive, which was only ever seen from behind, with
    close-ups of its flank, and of its wheels, shadow and ground.
    """
    log, scene = os.environ["KITTI_LOG"], work / "jam"
    if not scene.exists():
        sizes = ["--width", "1242", "--iterations", "3000", "--preset", "cpu-small"]
        command("reconstruct", log, "--out", scene, *sizes)
    loaded = load_scene(scene)
    car, times = "car_0", loaded.frame_times_us
    rows = {
        "as recorded": [],
        "turned by 35 degrees": [Rotate(object_id=car, angle=np.radians(35))],
        "turned by 90 degrees": [Rotate(object_id=car, angle=np.radians(90))],
        "turned by 180 degrees": [Rotate(object_id=car, angle=np.radians(180))],
        "moved": [Translate(object_id=car, x=4, y=1.2, frame="object", snap=True)],
        "deleted": [Delete(object_id=car)],
    }
    edits("jam.jpg", loaded, int(times[len(times) // 2]), rows, width=1242, near=car)


def edits(
    name: str,
    scene: Scene,
    t_us: int,
    rows: dict[str, list[Operation]],
    *,
    rows_shown: slice = slice(None),
    width: int = 960,
    near: str | None = None,
) -> None:
    """What the first camera sees after each of some batches of operations, one above the other.

    ``near`` names an object; two parts of each picture follow at twice the size, about its middle
    and about the ground below it.
    """
    camera, vehicle = scene.rig.cameras[0].resized(width), scene.ego.transform(t_us)
    recorded, pictures = ScenarioState.of(scene), []
    for caption, operations in rows.items():
        state = apply_operations(recorded, operations).state
        instances = instances_at(scene, state, t_us)
        [frame] = render_cameras(instances, [camera], vehicle, sky=scene.sky, backend="cpu")
        shown = np.ascontiguousarray(frame.rgb[rows_shown, :, ::-1])
        cv2.rectangle(shown, (0, 0), (10 * len(caption) + 24, 30), (44, 36, 32), -1)
        cv2.putText(
            shown, caption, (10, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235,) * 3, 1, cv2.LINE_AA
        )
        pictures.append(shown)
        if near is not None:
            subject = state.objects[near]
            middle = subject.trajectory.transform(t_us)[:3, 3]
            bottom = middle - [0, 0, subject.size[2] / 2]
            pictures.append(close_ups(shown, camera, vehicle, np.stack([middle, bottom])))
        pictures.append(np.full((6, width, 3), 255, np.uint8))
    save(name, np.concatenate(pictures[:-1]), width=width)


def close_ups(
    picture: np.ndarray, camera: Camera, vehicle: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """Parts of a picture about world points [N, 3], at twice the size, side by side."""
    pixels, _ = camera.project(apply_transform(camera.viewmat(vehicle), points))
    height, width = picture.shape[:2]
    half = np.array([width // (4 * len(points)), height // 5])
    parts = []
    for at in pixels:
        x, y = np.clip(np.round(at).astype(int) - half, 0, [width, height] - 2 * half)
        part = picture[y : y + 2 * half[1], x : x + 2 * half[0]]
        parts.append(cv2.resize(part, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
    strip = np.full((parts[0].shape[0], width, 3), 255, np.uint8)
    joined = np.concatenate(parts, axis=1)
    strip[:, : joined.shape[1]] = joined
    return strip


PICTURES = {
    make.__name__: make
    for make in (
        demo,
        film,
        scenario,
        studio,
        wall,
        pair,
        drop,
        crashes,
        ground,
        lenses,
        cars,
        people,
        jam,
    )
}


def command(*arguments: object) -> None:
    """Run a command of ``real2sim``."""
    subprocess.run([sys.executable, "-m", "real2sim", *map(str, arguments)], check=True)


@contextlib.contextmanager
def worker(work: Path, scenes: Path) -> Iterator[tuple[real2sim.Client, str]]:
    """A client of a worker with the demo's street, and its address."""
    data = work / "worker"
    shutil.rmtree(data, ignore_errors=True)
    with (
        worker_process(scenes=scenes, data=data, log_file=work / "worker.log") as running,
        real2sim.connect(running.url, timeout=600.0) as client,
    ):
        client.wait_ready(timeout=600.0)
        yield client, running.url


def read(path: Path) -> np.ndarray:
    """An image, BGR uint8 [H, W, 3]."""
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(path)
    return image


def save(name: str, image: np.ndarray, *, width: int) -> None:
    """Write an image into this folder, shrunk to ``width`` where it is wider."""
    height = round(image.shape[0] * width / image.shape[1])
    if image.shape[1] > width:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85] if name.endswith(".jpg") else []
    cv2.imwrite(str(HERE / name), image, quality)
    print(HERE / name)


if __name__ == "__main__":
    main()
