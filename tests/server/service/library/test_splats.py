"""Splats sent to the browser equal the scene's Gaussians up to the rounding of the format."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from real2sim_server.scene import GaussianCloud, SceneObject
from real2sim_server.scene.asset import person_asset
from real2sim_server.scene.io import read_splats, save_scene
from real2sim_server.service.library.views import SplatFiles


def received(client, tmp_path, **query):
    answer = client.get("/v1/scenes/tiny/splats", params={"up_axis": "z", **query})
    assert answer.status_code == 200, answer.text
    path = tmp_path / "part.spz"
    path.write_bytes(answer.content)
    return read_splats(path), int(answer.headers["X-Real2Sim-Total"])


def same_to_rounding(sent, cloud):
    torch.testing.assert_close(sent.means, cloud.means, atol=2**-13 + 1e-6, rtol=0)
    torch.testing.assert_close(sent.scales.log(), cloud.scales.log(), atol=1 / 31, rtol=0)
    torch.testing.assert_close(sent.opacities, cloud.opacities, atol=1 / 509, rtol=0)
    torch.testing.assert_close(sent.sh[:, 0], cloud.sh[:, 0], atol=1 / 76, rtol=0)
    assert (sent.quats * cloud.quats).sum(dim=1).abs().min() > 1 - 1e-4


def test_the_parts_add_up_to_the_background_ordered_by_importance(client, tiny_scene, tmp_path):
    background = tiny_scene.background
    parts = []
    for first in (0, 128, 256):
        sent, total = received(client, tmp_path, first=first, count=128)
        assert total == len(background)
        parts.append(sent)
    assert [len(p) for p in parts] == [128, 128, 44]
    ordered = background.select(background.by_importance())
    for first, part in zip((0, 128, 256), parts, strict=True):
        same_to_rounding(part, ordered.select(torch.arange(first, first + len(part))))
    assert len(received(client, tmp_path, first=300)[0]) == 0


def test_importance_is_opacity_times_area(tiny_scene):
    cloud = tiny_scene.background.select(torch.arange(4))
    cloud = type(cloud)(
        cloud.means,
        cloud.quats,
        torch.tensor([[1.0, 1, 9], [2, 2, 0.1], [5, 5, 5], [9, 0.1, 0.1]]),
        torch.tensor([0.5, 0.5, 0.1, 1.0]),
        cloud.sh,
    )
    assert cloud.by_importance().tolist() == [0, 2, 1, 3]


def test_an_object_is_sent_in_its_own_frame(client, tiny_scene, tmp_path):
    cloud = tiny_scene.object("car_red").cloud
    sent, total = received(client, tmp_path, object_id="car_red")
    assert total == len(cloud)
    same_to_rounding(sent, cloud.select(cloud.by_importance()))


def test_an_unknown_object_or_hash_is_not_found(client):
    answer = client.get("/v1/scenes/tiny/splats", params={"object_id": "nobody"})
    assert (answer.status_code, answer.json()["code"]) == (404, "UNKNOWN_OBJECT")
    for part in ("splats", "sky"):
        other = client.get(f"/v1/scenes/tiny/{part}", params={"content_hash": "0" * 64})
        assert (other.status_code, other.json()["code"]) == (404, "NOT_FOUND")


def test_a_response_is_cacheable_only_with_a_content_hash(client):
    known = client.get("/v1/scenes/tiny").json()["content_hash"]
    for part in ("splats", "sky"):
        url = f"/v1/scenes/tiny/{part}"
        kept = client.get(url, params={"content_hash": known})
        assert "immutable" in kept.headers["Cache-Control"]
        asked = client.get(url)
        assert "immutable" not in asked.headers["Cache-Control"]
        again = client.get(url, headers={"If-None-Match": asked.headers["ETag"]})
        assert (again.status_code, again.content) == (304, b"")
    tags = {
        client.get(url, params=q).headers["ETag"]
        for q in ({}, {"first": 1}, {"count": 1})
        for url in ["/v1/scenes/tiny/splats"]
    }
    assert len(tags) == 3


def test_the_sky_is_six_faces_side_by_side(client, tiny_scene):
    pixels = np.asarray(Image.open(io.BytesIO(client.get("/v1/scenes/tiny/sky").content)))
    faces = tiny_scene.sky.faces.numpy()
    assert pixels.shape == (faces.shape[1], 6 * faces.shape[1], 3)
    np.testing.assert_allclose(pixels / 255, np.concatenate(list(faces), axis=1), atol=1 / 509)


def test_a_cloud_is_sorted_once_and_each_part_packed_once(tiny_scene, monkeypatch):
    sorted_ = []
    monkeypatch.setattr(
        GaussianCloud,
        "by_importance",
        lambda cloud, real=GaussianCloud.by_importance: sorted_.append(cloud) or real(cloud),
    )
    files, cloud = SplatFiles(), tiny_scene.background
    parts = [files.part(cloud, ("a", ""), first, 128) for first in (0, 128)]
    assert files.part(cloud, ("a", ""), 0, 128) is parts[0]
    assert len(sorted_) == 1
    assert files.part(cloud, ("b", ""), 0, 128) == parts[0]
    assert len(sorted_) == 2


def test_the_least_recently_used_part_is_evicted(tiny_scene):
    cloud = tiny_scene.background
    one = len(SplatFiles().part(cloud, ("a", ""), 0, 128))
    files = SplatFiles(most_bytes=4 * len(cloud) + 2 * one + one // 2)
    first = files.part(cloud, ("a", ""), 0, 128)
    files.part(cloud, ("a", ""), 64, 128)
    assert files.part(cloud, ("a", ""), 0, 128) is first
    files.part(cloud, ("a", ""), 96, 128)
    assert files.part(cloud, ("a", ""), 0, 128) is first
    assert files.held_bytes <= 4 * len(cloud) + 2 * one + one // 2


def test_a_person_is_sent_in_the_rest_pose_with_a_header(run_worker, scenes_dir, tiny_scene):
    asset = person_asset("anna", "woman", height=1.7, gaussians=400)
    red = tiny_scene.object("car_red")
    anna = SceneObject(
        "anna", "pedestrian", asset.size, asset.cloud, red.trajectory, figure=asset.figure
    )
    crowd = replace(tiny_scene, name="crowd", objects={**tiny_scene.objects, "anna": anna})
    save_scene(crowd, scenes_dir / "crowd.r2s")
    with run_worker() as client:
        walking = client.get("/v1/scenes/crowd/splats", params={"object_id": "anna"})
        standing = client.get("/v1/scenes/crowd/splats", params={"object_id": "car_red"})
    assert walking.headers["X-Real2Sim-Figure"] == "rest"
    assert walking.headers["X-Real2Sim-Total"] == "400"
    assert "X-Real2Sim-Figure" not in standing.headers


def test_an_object_of_a_scenario_is_sent_as_edited(client, tiny_scene, tmp_path):
    client.post("/v1/assets", json={"asset_id": "anna", "build": "woman", "height": 1.7})
    made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
    pose = {"position": [9.0, 1.0, 0.9]}
    insert = {"op": "insert", "asset_id": "anna", "object_id": "visitor", "pose": pose}
    wide = {"op": "scale", "object_id": "car_red", "y": 2.0}
    answer = client.post(f"/v1/scenarios/{made}/operations", json={"operations": [insert, wide]})
    assert answer.status_code == 200, answer.text

    def splats(object_id, **query):
        path = tmp_path / "one.spz"
        sent = client.get(
            f"/v1/scenarios/{made}/splats", params={"object_id": object_id, "up_axis": "z", **query}
        )
        assert sent.status_code == 200, sent.text
        path.write_bytes(sent.content)
        return read_splats(path), sent.headers.get("X-Real2Sim-Figure")

    red, posed = splats("car_red")
    cloud = tiny_scene.object("car_red").cloud.stretched((1.0, 2.0, 1.0))
    same_to_rounding(red, cloud.select(cloud.by_importance()))
    assert posed is None
    person, posed = splats("visitor", t_us=0)
    assert posed == "posed"
    assert len(person) > 1000
    unknown = client.get(f"/v1/scenarios/{made}/splats", params={"object_id": "nobody"})
    assert (unknown.status_code, unknown.json()["code"]) == (404, "UNKNOWN_OBJECT")


def test_a_downloaded_file_is_imported_upright(client, tiny_scene):
    """Without options in either direction."""
    known = {"first": 0, "count": 100_000}
    for url, name in [("/v1/scenes/tiny/splats", "street"), ("/v1/scenarios/{}/splats", "red")]:
        made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]
        query = known if name == "street" else {"object_id": "car_red"}
        sent = client.get(url.format(made), params=query)
        assert sent.status_code == 200, sent.text
        file = {"file": (f"{name}.spz", sent.content)}
        answer = client.post("/v1/scenes", files=file)
        assert answer.status_code == 201, answer.text
        cloud = tiny_scene.background if name == "street" else tiny_scene.object("car_red").cloud
        info = answer.json()
        assert info["provenance"]["up_axis"] == "y"
        np.testing.assert_allclose(info["extent_min"], cloud.means.amin(0), atol=1e-3)
        np.testing.assert_allclose(info["extent_max"], cloud.means.amax(0), atol=1e-3)
