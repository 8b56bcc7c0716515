from __future__ import annotations

import cv2
import numpy as np
import pytest

from real2sim_proto import ErrorCode
from real2sim_proto.scenes import AssetInfo
from real2sim_server.scene.io import export_scene, write_splats

CUT = {"scene": "tiny", "object_id": "car_red", "asset_id": "red"}
THERE = {"position": [20.0, 3.0, 5.0]}


def create(client) -> str:
    return client.post("/v1/scenarios", json={"scene": "tiny"}).json()["scenario_id"]


def edit(client, scenario, *operations):
    url = f"/v1/scenarios/{scenario}/operations"
    return client.post(url, json={"operations": list(operations)})


def objects(client, scenario) -> dict[str, dict]:
    info = client.get(f"/v1/scenarios/{scenario}").json()
    return {o["object_id"]: o for o in info["objects"]}


def upload(client, path, **fields):
    with path.open("rb") as file:
        return client.post("/v1/assets", files={"file": (path.name, file)}, data=fields)


JSON = {"Content-Type": "application/json"}


@pytest.fixture(params=[".ply", ".compressed.ply", ".spz", ".splat"])
def splat_file(request, tmp_path, tiny_scene):
    path = tmp_path / f"thing{request.param}"
    write_splats(tiny_scene.objects["car_red"].cloud, path)
    return path


def test_an_object_is_cut_out_of_a_scene_with_its_ambient_light(client):
    answer = client.post("/v1/assets", json=CUT)
    info = AssetInfo.model_validate(answer.json())
    assert answer.status_code == 201
    assert answer.headers["Location"] == "/v1/assets/red"
    assert (info.category, info.size, info.gaussians) == ("car", (4.0, 1.8, 1.5), 60)
    # The test street is uniformly grey (0.4).
    assert info.ambient == pytest.approx((0.4, 0.4, 0.4), abs=0.01)
    assert client.get("/v1/assets").json()["assets"] == [answer.json()]
    assert client.get("/v1/assets/red").json() == answer.json()


def test_an_existing_asset_cannot_be_overwritten(client):
    client.post("/v1/assets", json=CUT)
    again = client.post("/v1/assets", json=CUT | {"object_id": "post"})
    assert again.json()["code"] == ErrorCode.ALREADY_EXISTS


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"scene": "nowhere"}, ErrorCode.UNKNOWN_SCENE),
        ({"object_id": "nobody"}, ErrorCode.UNKNOWN_OBJECT),
        ({"asset_id": "../evil"}, ErrorCode.INVALID_REQUEST),
        ({"colour": "red"}, ErrorCode.INVALID_REQUEST),
    ],
)
def test_an_invalid_cut_is_refused(client, change, code):
    assert client.post("/v1/assets", json=CUT | change).json()["code"] == code


def test_a_body_nested_too_deeply_is_refused(client):
    answer = client.post("/v1/assets", content="[" * 100_000, headers=JSON)
    assert (answer.status_code, answer.json()["code"]) == (422, "INVALID_REQUEST")


def test_every_splat_format_can_be_uploaded_with_a_metric_length(client, splat_file):
    answer = upload(client, splat_file, category="truck", up_axis="z", length="8")
    info = AssetInfo.model_validate(answer.json())
    assert answer.status_code == 201, answer.text
    assert (info.asset_id, info.category) == ("thing", "truck")
    assert info.size[0] == pytest.approx(8.0)
    # Width and height keep the proportions of the file's Gaussians.
    assert info.size[1] / info.size[0] == pytest.approx(1.8 / 4.0, rel=0.1)


@pytest.mark.parametrize(
    ("name", "axis"), [("spz", "y"), ("ply", "z"), ("compressed.ply", "z"), ("splat", "z")]
)
def test_an_exported_object_is_uploaded_upright(client, tiny_scene, tmp_path, name, axis):
    export_scene(tiny_scene, tmp_path / "out", format=name, objects=["car_red"])
    answer = upload(client, tmp_path / "out" / f"001_car_red.{name}", length="4")
    info = AssetInfo.model_validate(answer.json())
    assert info.provenance["up_axis"] == axis
    assert bool(info.provenance["notes"]) == (name == "splat")
    # The size of the car.
    assert info.size == pytest.approx((4.0, 1.8, 1.5), rel=0.1)


def test_a_file_that_is_not_a_splat_file_is_refused_and_leaves_no_asset(client, tmp_path):
    path = tmp_path / "thing.ply"
    path.write_bytes(b"ply\nnot really")
    answer = upload(client, path)
    assert answer.json()["code"] == ErrorCode.IMPORT_FAILED
    assert str(tmp_path) not in answer.text
    assert client.get("/v1/assets").json()["assets"] == []


def test_an_upload_without_a_file_is_refused(client):
    answer = client.post("/v1/assets", files={"other": b"x"})
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST


def test_a_thumbnail_shows_the_asset_on_a_light_background(client):
    client.post("/v1/assets", json=CUT)
    answer = client.get("/v1/assets/red/thumbnail", params={"width": 128})
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    assert answer.headers["Content-Type"] == "image/png"
    assert picture.shape == (96, 128, 3)
    red, green, _ = picture[48, 64].astype(int)
    assert red > 150 > 80 > green
    assert picture[2, 2].min() > 200


def test_an_inserted_asset_is_a_regular_object(client):
    client.post("/v1/assets", json=CUT)
    scenario = create(client)
    insert = {"op": "insert", "asset_id": "red", "pose": THERE}
    result = edit(client, scenario, insert).json()
    assert result["created"] == ["red_1"]
    shown = objects(client, scenario)["red_1"]
    assert (shown["asset_id"], shown["recorded_id"], shown["gaussians"]) == ("red", None, 60)
    # Inserted five metres up, it is placed on the ground.
    assert shown["trajectory"]["positions"][0][2] == pytest.approx(0.75, abs=0.05)
    moved = edit(client, scenario, {"op": "translate", "object_id": "red_1", "x": -4.0})
    assert moved.status_code == 200


def test_an_inserted_asset_is_rendered_with_its_instance_id(client):
    client.post("/v1/assets", json=CUT)
    scenario = create(client)
    edit(client, scenario, {"op": "insert", "asset_id": "red", "pose": {"position": [9, 0, 1]}})
    answer = client.get(
        f"/v1/scenarios/{scenario}/preview",
        params={"camera": "front", "modality": "instance"},
        headers={"Accept": "image/png"},
    )
    ids = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert (ids == 4).sum() > 50


def test_a_scenario_with_assets_survives_a_restart(run_worker):
    with run_worker() as client:
        client.post("/v1/assets", json=CUT)
        scenario = create(client)
        edit(client, scenario, {"op": "replace", "object_id": "car_blue", "asset_id": "red"})
        before = objects(client, scenario)
    with run_worker() as client:
        assert objects(client, scenario) == before
        assert before["car_blue"]["asset_id"] == "red"
        preview = client.get(f"/v1/scenarios/{scenario}/preview", params={"camera": "front"})
        assert preview.status_code == 200


def test_an_unknown_asset_is_refused_with_a_pointer_to_the_operation(client):
    answer = edit(client, create(client), {"op": "insert", "asset_id": "bus", "pose": THERE})
    assert answer.status_code == 404
    assert answer.json()["code"] == ErrorCode.UNKNOWN_ASSET
    assert answer.json()["errors"][0]["pointer"] == "/operations/0"


def test_an_unused_asset_can_be_deleted_and_its_id_reused(client):
    assert client.post("/v1/assets", json=CUT).status_code == 201
    assert client.delete("/v1/assets/red").status_code == 204
    assert client.get("/v1/assets").json()["assets"] == []
    assert client.delete("/v1/assets/red").json()["code"] == ErrorCode.UNKNOWN_ASSET
    assert client.post("/v1/assets", json=CUT).status_code == 201


def test_an_asset_in_a_history_cannot_be_deleted_before_the_scenario(client):
    client.post("/v1/assets", json=CUT)
    scenario = create(client)
    edit(client, scenario, {"op": "insert", "asset_id": "red", "pose": THERE})
    client.post(f"/v1/scenarios/{scenario}/undo")
    refused = client.delete("/v1/assets/red")
    assert (refused.status_code, refused.json()["code"]) == (409, ErrorCode.ASSET_IN_USE)
    assert scenario in refused.json()["detail"]
    assert client.post(f"/v1/scenarios/{scenario}/redo").status_code == 200
    client.delete(f"/v1/scenarios/{scenario}")
    assert client.delete("/v1/assets/red").status_code == 204


def test_an_asset_whose_id_resembles_a_used_id_can_be_deleted(client):
    for name in ("red", "red_2", "redx2"):
        client.post("/v1/assets", json=CUT | {"asset_id": name})
    edit(client, create(client), {"op": "insert", "asset_id": "redx2", "pose": THERE})
    assert client.delete("/v1/assets/red").status_code == 204
    assert client.delete("/v1/assets/red_2").status_code == 204


PERSON = {"asset_id": "anna", "build": "woman", "height": 1.7, "clothes": {"top": [0.9, 0.1, 0.1]}}


def track(speed: float, height: float = 0.8) -> dict:
    """A track across the street, ahead of the ego and to the left."""
    times = [0, 500_000, 1_000_000]
    half = 2**-0.5
    return {
        "times_us": times,
        "positions": [[7.0, -1.5 + speed * t * 1e-6, height] for t in times],
        "quaternions": [[half, 0.0, 0.0, half]] * 3,
    }


def picture(client, scenario, t_us: int) -> np.ndarray:
    query, headers = {"t_us": t_us, "camera": "front"}, {"Accept": "image/png"}
    answer = client.get(f"/v1/scenarios/{scenario}/preview", params=query, headers=headers)
    assert answer.status_code == 200, answer.text
    return cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)


def test_a_generated_person_walks_along_a_trajectory(client):
    answer = client.post("/v1/assets", json=PERSON)
    info = AssetInfo.model_validate(answer.json())
    assert answer.status_code == 201, answer.text
    assert (info.category, info.asset_id) == ("pedestrian", "anna")
    assert info.size[2] == pytest.approx(1.7, abs=0.05)
    scenario = create(client)
    before = picture(client, scenario, 500_000)
    inserted = edit(
        client, scenario, {"op": "insert", "asset_id": "anna", "trajectory": track(1.4)}
    )
    assert inserted.status_code == 200, inserted.text
    shown = picture(client, scenario, 500_000)
    seen = np.abs(shown.astype(int) - before).max(axis=2) > 20
    assert seen.sum() > 30
    # At another speed through the same place, the leg pose differs.
    (name,) = inserted.json()["created"]
    there = track(1.4)
    slower = there | {"positions": [[7.0, -1.15 + 0.7 * t * 1e-6, 0.8] for t in there["times_us"]]}
    changed = edit(
        client, scenario, {"op": "set_trajectory", "object_id": name, "trajectory": slower}
    )
    assert changed.status_code == 200, changed.text
    assert (picture(client, scenario, 500_000) != shown).any()


@pytest.mark.parametrize(
    "change", [{"build": "giraffe"}, {"height": 3.0}, {"clothes": {"hat": [0, 0, 0]}}]
)
def test_an_invalid_person_is_refused(client, change):
    answer = client.post("/v1/assets", json=PERSON | change)
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST
