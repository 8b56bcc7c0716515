"""The 3D view, rendered by the page in software WebGL, which needs a core of its own."""

from __future__ import annotations

import base64
import io
from typing import Any

import httpx2
import numpy as np
import pytest
from PIL import Image

import real2sim
from real2sim_server.geometry import matrix_to_quaternion
from tests.waiting import wait_until

from .hands import drag, kept, shown

pytestmark = [pytest.mark.browser, pytest.mark.network, pytest.mark.slow]
MIN_PSNR = 38.0
"""[dB]. Measured: 45."""


@pytest.fixture(scope="module")
def browser_args() -> list[str]:
    """WebGL in software, without the watchdog that ends it on a busy machine."""
    return [
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-gpu-watchdog",
    ]


def opened(studio: Any, width: int = 700) -> Any:
    """The 3D view with the whole scene, small because it is rendered in software."""
    studio.set_viewport_size({"width": width, "height": 560})
    studio.click("#space-mode")
    studio.wait_for_selector("#space[data-whole][data-detail=whole]")
    wait_drawn(studio)
    return studio


def wait_drawn(page: Any) -> None:
    """Wait until the canvas is stable. Some images are drawn after the last change."""
    seen: list[np.ndarray] = []

    def stays() -> bool:
        seen.append(drawn(page))
        page.wait_for_timeout(300)
        return len(seen) > 3 and all(np.array_equal(seen[-1], one) for one in seen[-4:])

    wait_until(stays, "the canvas to stay as it is")


def image_of(encoded: str) -> np.ndarray:
    """[H, W, 3] of a base64 image."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"))


def drawn(page: Any) -> np.ndarray:
    """The current canvas without overlays [H, W, 3]."""
    url = page.evaluate("() => document.getElementById('space').toDataURL()")
    return image_of(url.partition(",")[2])


def of_worker(page: Any, running: Any) -> np.ndarray:
    """The worker's render from the same camera, at the size of the canvas."""
    view = page.evaluate("async () => (await import('/ui/space.js')).view()")
    T = np.reshape(view["T"], (4, 4))
    camera = {
        "name": "same",
        "width": view["width"],
        "height": view["height"],
        "K": np.reshape(view["K"], (3, 3)).tolist(),
        "pose": {
            "position": T[:3, 3].tolist(),
            "quaternion": matrix_to_quaternion(T[:3, :3]).tolist(),
        },
    }
    body = {"t_us": shown(page, "model.t"), "cameras": [camera]}
    answer = httpx2.post(
        f"{running.url}/v1/scenes/tiny/render", json=body, headers={"Accept": "image/png"}
    )
    return image_of(base64.b64encode(answer.raise_for_status().content).decode())


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = np.mean((a.astype(float) - b.astype(float)) ** 2)
    return float(10 * np.log10(255**2 / error))


def test_the_page_matches_the_worker_and_dragging_the_background_orbits(studio, running):
    page = opened(studio)
    exact = of_worker(page, running)
    assert drawn(page).shape == exact.shape
    assert exact.std() > 10
    wait_until(
        lambda: psnr(drawn(page), exact) > MIN_PSNR,
        lambda: f"the worker's picture: {psnr(drawn(page), exact):.1f} dB",
    )
    before = shown(page, "model.free")
    box = page.locator("#stage").bounding_box()
    drag(page, (box["x"] + 40, box["y"] + 20), (60, 0))
    after = shown(page, "model.free")
    assert np.abs(np.subtract(after, before)).max() > 0.1
    assert shown(page, "model.scenario.revision") == 0
    R = np.reshape(after, (4, 4))[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)


def middle_of(page: Any, name: str) -> tuple[float, float]:
    inside = page.evaluate(
        "async (id) => (await import('/ui/camera_view.js')).stagePlace(id)", name
    )
    box = page.locator("#stage").bounding_box()
    return box["x"] + inside[0], box["y"] + inside[1]


def test_a_dragged_object_moves_immediately_and_makes_one_edit(studio):
    page = opened(studio)
    place = "model.scenario.objects.find((o) => o.object_id === 'car_red').trajectory.positions[0]"
    before, pixels = shown(page, place), drawn(page)
    x, y = middle_of(page, "car_red")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 25, y + 6, steps=4)
    assert shown(page, "model.selected") == "car_red"
    assert shown(page, "model.scenario.revision") == 0
    wait_until(
        lambda: np.abs(drawn(page).astype(int) - pixels).max() > 60, "the object to move at once"
    )
    page.mouse.up()
    kept(page, 1)
    after = shown(page, place)
    assert np.hypot(after[0] - before[0], after[1] - before[1]) > 0.3
    assert shown(page, "model.history.entries.length") == 1


def test_dragging_the_ring_of_an_object_turns_it(studio):
    page = opened(studio)
    yaw = "model.scenario.objects.find((o) => o.object_id === 'car_red').trajectory.quaternions[0]"
    before = shown(page, yaw)
    page.evaluate("async () => (await import('/ui/model.js')).select('car_red')")
    ring = page.evaluate(
        """async () => {
            const { model, object } = await import('/ui/model.js');
            const { ringOf } = await import('/ui/space_hands.js');
            const { project } = await import('/ui/poses.js');
            const { view } = await import('/ui/space.js');
            const { T, K } = view();
            return ringOf(object(model.selected)).map((point) => project(point, T, K));
        }"""
    )
    box = page.locator("#stage").bounding_box()
    # The nearest point of the ring is the lowest in the image: next to the car, on the road.
    x, y = max((p for p in ring if p), key=lambda p: p[1])
    drag(page, (box["x"] + x, box["y"] + y), (40, 0))
    kept(page, 1)
    after = shown(page, yaw)
    turned = 2 * np.arccos(min(1.0, abs(float(np.dot(before, after)))))
    assert 0.05 < turned < 2.0
    assert shown(page, "model.history.entries[0].operations[0].op") in {"rotate", "set_pose"}


def test_a_slow_device_shows_the_workers_picture_of_the_same_camera(studio):
    """Simulates software rendering: a part that claims a million splats and is slow to draw."""

    def one_of_many(route: Any) -> None:
        answer = route.fetch()
        headers = {**answer.headers, "x-real2sim-total": "1000000"}
        route.fulfill(response=answer, headers=headers)

    studio.route("**/splats?*", one_of_many)
    studio.evaluate(
        "async () => { const { Pace } = await import('/ui/pace.js');"
        " Pace.prototype.fastest = async () => 400; }"
    )
    studio.set_viewport_size({"width": 700, "height": 560})
    studio.click("#space-mode")
    studio.wait_for_selector("#space.remote")
    studio.wait_for_selector("#messages:has-text('without a GPU')")
    before = studio.get_attribute("#picture", "data-seq")
    x, y = middle_of(studio, "car_red")
    place = "model.scenario.objects.find((o) => o.object_id === 'car_red').trajectory.positions[0]"
    drag(studio, (x, y), (25, 6))
    kept(studio, 1)
    assert shown(studio, place)[1] != pytest.approx(0.0, abs=1e-3)
    wait_until(
        lambda: int(studio.get_attribute("#picture", "data-seq")) > int(before or 0),
        "the next picture",
    )


def test_a_static_picture_is_reported_complete_after_more_data_arrives(studio):
    """Another object arrives while nothing moves, and is already shown completely."""
    studio.evaluate(
        """async () => {
          const { Pace } = await import('/ui/pace.js');
          const gl = {
            TIMEOUT_EXPIRED: 1, fenceSync: () => ({}), clientWaitSync: () => 0,
            deleteSync: () => {}, flush: () => {},
          };
          const world = { total: () => window.total, show: () => false, ordering: () => false };
          Object.assign(window, { total: 100, told: [] });
          window.pace = new Pace(gl, world, () => window.told.push(window.pace.whole()));
          window.pace.moved();
        }"""
    )
    rests = "() => window.pace.resting() && !window.pace.waiting && window.told.at(-1)"
    studio.wait_for_function(rests)
    studio.evaluate("() => { window.total = 150; window.pace.request(); }")
    studio.wait_for_function("() => window.told.includes(false)")
    studio.wait_for_function("() => window.told.at(-1)")


def test_without_webgl_the_workers_picture_is_kept(studio):
    studio.evaluate(
        "() => { const real = HTMLCanvasElement.prototype.getContext;"
        " HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        " return kind === 'webgl2' ? null : real.call(this, kind, ...more); }; }"
    )
    studio.wait_for_selector("#picture[data-seq]")
    studio.click("#space-mode")
    studio.wait_for_selector("#messages:has-text('WebGL2')")
    assert not studio.is_visible("#space")
    assert studio.get_attribute("#space-mode", "aria-pressed") == "false"
    assert studio.is_visible("#picture")


CONVERGES = """async ([each, total]) => {
    const { Detail } = await import('/ui/detail.js');
    const detail = new Detail();
    let chosen;
    for (let k = 0; k < 40; k++) {
        chosen = detail.moving(total);
        detail.took(5 + detail.shown * each, { resting: false });
    }
    const moving = { ...chosen, shown: detail.shown };
    const steps = [];
    while (!detail.whole(total)) {
        detail.resting(total);
        steps.push(detail.shown);
        detail.took(5 + detail.shown * each, { resting: true });
    }
    return { moving, steps, after: detail.moving(total).share };
}"""


def test_a_moving_view_draws_as_many_splats_as_fit_the_frame_time(page):
    total = 360_000
    for each in (4e-3, 4e-4):
        told = page.evaluate(CONVERGES, [each, total])
        assert told["moving"]["share"] < 0.5
        assert told["moving"]["scale"] < 1
        assert told["moving"]["shown"] * each < 70 or told["moving"]["shown"] <= 16384
        assert told["steps"] == sorted(told["steps"])
        assert told["steps"][-1] == total
        assert told["after"] == pytest.approx(told["moving"]["share"])
    # If all splats fit, all are drawn while moving.
    told = page.evaluate(CONVERGES, [1e-5, 360_000])
    assert told["moving"] == {"share": 1, "scale": 1, "shown": 360_000}
    assert told["steps"] == []


def test_a_partial_scene_has_the_most_important_splats(studio):
    active = studio.evaluate(
        """async () => {
            const { SplatWorld } = await import('/ui/splat_world.js');
            const { view } = await import('/ui/space.js');
            const { model, emit } = await import('/ui/model.js');
            const canvas = document.createElement('canvas');
            const world = new SplatWorld(canvas, model.scene, { draw: () => {}, again: () => {} });
            await world.load();
            world.pace.stop();
            const counts = [];
            for (const share of [1, 0.5, 0.1]) {
                world.show({ share, scale: 1 });
                await world.pace.prepare();
                counts.push(world.spark.activeSplats);
            }
            const later = await world.cloudAt(world.url('splats', { object_id: 'car_red' }));
            const { count } = world.splats.get(later.splats);
            const joins = [count, later.splats.numSplats];
            return { counts, total: world.total(), joins };
        }"""
    )
    total = active["total"]
    assert total > 200
    assert active["counts"] == [total, -(-total // 2), -(-total // 10)]
    # Later objects arrive with the same share, so nothing has to be reordered.
    whole, share = active["joins"]
    assert whole > 10
    assert share == -(-whole // 10)


def test_people_assets_and_scaled_objects_are_drawn_as_edited(studio, running):
    page = opened(studio)
    total = int(page.get_attribute("#space", "data-total"))
    before = drawn(page)
    with real2sim.connect(running.url) as sim:
        sim.assets.person(
            asset_id="anna", build="woman", height=1.7, clothes={"top": (0.9, 0.1, 0.1)}
        )
        scenario = sim.scenarios.get(shown(page, "model.scenario.scenario_id"))
        scenario.insert("anna", position=(6.0, -2.5, 0.9), object_id="visitor")
        scenario.objects["car_red"].scale(x=1.5)
        scenario.objects["post"].scale(x=1.2, y=1.2, z=1.2)
    with page.expect_request("**/splats?object_id=visitor**"):
        page.evaluate("async () => (await import('/ui/model.js')).refresh()")
    wait_until(lambda: page.get_attribute("#space", "data-boxes") == "", "all to come")
    wait_until(
        lambda: int(page.get_attribute("#space", "data-total")) > total + 1000, "the visitor"
    )
    x, y = page.evaluate("async () => (await import('/ui/camera_view.js')).stagePlace('visitor')")
    around = (slice(int(y) - 8, int(y) + 8), slice(int(x) - 4, int(x) + 4))
    wait_until(
        lambda: np.abs(drawn(page).astype(int) - before)[around].max() > 60,
        "the visitor to be drawn",
    )
    # Only walking people are requested for every instant.
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.click("#next")
    t_us = shown(page, "model.t")
    instant = f"object_id=visitor&t_us={t_us}"
    wait_until(lambda: any(instant in url for url in list_of(page, asked)), "the instant")
    assert not [url for url in asked if "splats" in url and "visitor" not in url]
    # Drawing does not wait for them.
    held = []

    def hold(route):
        held.append(route)

    page.route("**/splats?object_id=visitor**", hold)
    pictures = int(page.get_attribute("#space", "data-drawn"))
    page.click("#next")
    wait_until(lambda: list_of(page, held), "the next instant")
    wait_until(lambda: int(page.get_attribute("#space", "data-drawn")) > pictures, "a picture")
    page.unroute_all()


def list_of(page: Any, asked: list[str]) -> list[str]:
    """The requests so far, once the browser has reported them."""
    page.wait_for_timeout(1)
    return list(asked)
