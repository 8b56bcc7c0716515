from __future__ import annotations

import cv2
import numpy as np
import pytest

from real2sim_proto import ErrorCode

from ..waiting import finished

PUSH = {"op": "set_velocity", "object_id": "car_red", "linear": [6.0, 0.0, 0.0]}
SHORT = {"end_us": 300_000, "frame_us": 100_000, "objects": ["car_red"]}


@pytest.fixture
def scenario(client) -> str:
    made = client.post("/v1/scenarios", json={"scene": "tiny"}).json()
    return f"/v1/scenarios/{made['scenario_id']}"


def edit(client, url, *operations) -> None:
    answer = client.post(f"{url}/operations", json={"operations": list(operations)})
    assert answer.status_code == 200, answer.text


def test_a_pushed_car_moves_and_its_rollout_can_be_rendered(client, scenario):
    edit(client, scenario, PUSH)
    job = finished(client, client.post(f"{scenario}/simulate", json=SHORT))
    assert job["state"] == "succeeded", job
    assert (job["result"]["frames"], job["result"]["objects"]) == (4, ["car_red"])

    url = f"/v1/jobs/{job['job_id']}"
    playback = client.get(f"{url}/files/playback.json").json()
    way = np.array(playback["tracks"]["car_red"]["positions"])
    assert 0.8 < way[-1, 0] - way[0, 0] < 1.9
    assert playback["times_us"] == [0, 100_000, 200_000, 300_000]
    assert len(playback["energies"][0]) == len(playback["energy_names"])

    ids = []
    for t_us in (0, 300_000):
        asked = {"camera": "front", "modality": "instance", "t_us": t_us}
        answer = client.get(f"{url}/preview", params=asked, headers={"Accept": "image/png"})
        ids.append(cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED))
    assert (ids[0] == 1).any()
    assert (ids[0] != ids[1]).any()

    asked = {"simulation": job["job_id"], "camera": "front", "width": 64}
    video_source = finished(client, client.post("/v1/exports", json=asked))
    assert video_source["result"]["frames"] == 4


def test_the_rollout_uses_the_mass_speed_and_collider_set_by_operations(client, scenario):
    wall = {"kind": "box", "position": [17.0, -3.0, 1.0], "size": [1.0, 4.0, 2.0]}
    edit(
        client,
        scenario,
        {"op": "set_physics", "object_id": "car_red", "mass": 950.0},
        PUSH,
        {"op": "add_collider", "collider_id": "barrier", "shape": wall},
    )
    job = finished(client, client.post(f"{scenario}/simulate", json=SHORT | {"end_us": 250_000}))
    assert job["state"] == "succeeded", job
    hits = {(c["object_id"], c["other"]): c for c in job["result"]["contacts"]}
    hit = hits["car_red", "barrier"]
    # Half a metre at 6 m/s. This car's Gaussians extend slightly beyond its box.
    assert 0.02 < hit["first_s"] < 0.1
    assert 5.0 < hit["delta_v"] < 9.0
    assert hit["impulse"][0] == pytest.approx(-950.0 * hit["delta_v"], rel=0.05)

    files = f"/v1/jobs/{job['job_id']}/files"
    own = client.get(f"{files}/playback.json").json()["tracks"]["car_red"]
    assert own["mass"] == pytest.approx(950.0)
    assert own["velocities"][0] == pytest.approx([6.0, 0.0, 0.0])
    assert own["velocities"][-1][0] < 1.0


def test_parameters_of_the_paper_and_a_cylinder_collider_are_applied(client, scenario):
    post = {"kind": "cylinder", "position": [16.7, -3.0, 1.0], "radius": 0.1, "height": 3.0}
    table = {"young": 2e6, "poisson": 0.4, "density": 200.0, "friction": 0.0, "grid": 30}
    edit(
        client,
        scenario,
        {"op": "set_physics", "object_id": "car_red"} | table | {"grid": 40},
        PUSH,
        {"op": "add_collider", "collider_id": "pole", "shape": post},
    )
    asked = SHORT | {"physics": {"*": {"grid": 30}}, "gravity": [0, 0, 0], "end_us": 200_000}
    job = finished(client, client.post(f"{scenario}/simulate", json=asked))
    assert job["state"] == "succeeded", job
    figures = job["result"]["figures"]
    car = client.get(f"{scenario}").json()
    size = next(o["size"] for o in car["objects"] if o["object_id"] == "car_red")
    assert figures["cell"] == pytest.approx(2 * max(size) / 30)
    assert figures["gravity"] == [0, 0, 0]
    assert ("car_red", "pole") in {(c["object_id"], c["other"]) for c in job["result"]["contacts"]}
    assert [c["shape"]["kind"] for c in car["colliders"]] == ["cylinder"]


@pytest.mark.parametrize(
    ("asked", "code", "words"),
    [
        ({"physics": {"post": {"mass": 3}}}, "UNKNOWN_OBJECT", "is not simulated"),
        ({"physics": {"*": {"young": 0}}}, "INVALID_REQUEST", "greater than 0"),
        ({"physics": {"*": {"mass": 1, "density": 1}}}, "INVALID_REQUEST", "not both"),
        ({"speed": 3}, "INVALID_REQUEST", "speed is of an experiment"),
    ],
)
def test_invalid_values_are_refused(client, scenario, asked, code, words):
    answer = client.post(f"{scenario}/simulate", json=SHORT | asked)
    assert answer.status_code in {404, 422}
    assert answer.json()["code"] == code
    assert words in answer.text


def test_an_open_mesh_is_refused_with_a_hint(client, scenario):
    mesh = {"kind": "mesh", "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "triangles": [[0, 1, 2]]}
    operations = [{"op": "add_collider", "shape": mesh}]
    answer = client.post(f"{scenario}/operations", json={"operations": operations})
    assert (answer.status_code, answer.json()["code"]) == (422, "INVALID_OPERATION")
    assert "3 edges do not belong to two triangles" in answer.json()["detail"]
    assert "thickness" in answer.json()["hint"]


def test_an_experiment_of_the_paper_runs_as_a_job(client, scenario):
    asked = {"experiment": "wall", "objects": ["car_red"], "speed": 5, "end_us": 150_000}
    job = finished(client, client.post(f"{scenario}/simulate", json=asked))
    assert job["state"] == "succeeded", job
    assert job["result"]["figures"]["preset"] == "paper"
    assert ("car_red", "wall") in {(c["object_id"], c["other"]) for c in job["result"]["contacts"]}


def test_a_rollout_that_starts_inside_a_collider_fails_with_the_reason(client, scenario):
    inside = {"kind": "box", "position": [14.0, -3.0, 1.0], "size": [1.0, 4.0, 2.0]}
    edit(client, scenario, PUSH, {"op": "add_collider", "collider_id": "in", "shape": inside})
    job = finished(client, client.post(f"{scenario}/simulate", json=SHORT))
    assert job["state"] == "failed"
    assert "inside collider 'in'" in job["error"]["detail"]


@pytest.mark.parametrize(
    ("operation", "field"),
    [
        ({"op": "set_physics", "object_id": "car_red", "mass": 0.0}, "mass"),
        ({"op": "set_physics", "object_id": "car_red", "mass": -1200.0}, "mass"),
        ({"op": "set_physics", "object_id": "car_red", "friction": -0.1}, "friction"),
        ({"op": "set_physics", "object_id": "car_red", "restitution": 1.5}, "restitution"),
        ({"op": "set_physics", "object_id": "car_red", "material": "cheese"}, "material"),
        ({"op": "set_physics", "object_id": "car_red", "poisson": 0.5}, "poisson"),
        ({"op": "set_physics", "object_id": "car_red", "young": -2e6}, "young"),
        ({"op": "set_velocity", "object_id": "car_red", "linear": [1e6, 0, 0]}, "linear"),
        ({"op": "add_collider", "shape": {"kind": "box", "size": [0, 1, 1]}}, "shape"),
        ({"op": "set_physics", "object_id": "car_red", "grid": 2000}, "grid"),
        (
            {"op": "set_physics", "object_id": "car_red", "material": "jelly", "yield_stress": 9.0},
            "yield_stress",
        ),
        ({"op": "add_collider", "shape": {"kind": "cylinder", "radius": 0}}, "radius"),
        (
            {
                "op": "add_collider",
                "shape": {"kind": "plane", "point": [0, 0, 0], "normal": [0] * 3},
            },
            "normal",
        ),
    ],
)
def test_invalid_physics_are_refused_with_the_field_name(client, scenario, operation, field):
    answer = client.post(f"{scenario}/operations", json={"operations": [operation]})
    assert answer.status_code == 422
    problem = answer.json()
    assert problem["code"] == ErrorCode.INVALID_REQUEST
    assert field in str(problem)
    assert client.get(scenario).json()["revision"] == 0


def test_errors_found_during_the_rollout_fail_the_job_but_not_the_worker(client, scenario):
    start = client.post(f"{scenario}/simulate", json=SHORT | {"objects": ["car_red", "car_blue"]})
    assert finished(client, start)["state"] == "succeeded"
    onto_it = {
        "op": "set_pose",
        "object_id": "car_red",
        "pose": {"position": [8.0, 0.0, 0.75], "quaternion": [1, 0, 0, 0]},
    }
    too_fast = PUSH | {"linear": [150.0, 150.0, 0.0]}
    for operation, objects, reason in [
        (too_fast, ["car_red"], "at most 200 m/s"),
        (onto_it, ["car_red", "car_blue"], "inside each other"),
    ]:
        edit(client, scenario, operation)
        job = finished(
            client, client.post(f"{scenario}/simulate", json=SHORT | {"objects": objects})
        )
        assert (job["state"], job["error"]["code"]) == ("failed", ErrorCode.INVALID_REQUEST), job
        assert reason in job["error"]["detail"]
        client.post(f"{scenario}/undo")
    assert finished(client, client.post(f"{scenario}/simulate", json=SHORT))["state"] == "succeeded"


def test_simulating_without_any_motion_is_refused(client, scenario):
    answer = client.post(f"{scenario}/simulate")
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST
    assert "set_velocity" in answer.json()["hint"]


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"objects": ["nobody"]}, ErrorCode.UNKNOWN_OBJECT),
        ({"end_us": 9_000_000}, ErrorCode.TIME_OUT_OF_RANGE),
        ({"preset": "magic"}, ErrorCode.INVALID_REQUEST),
    ],
)
def test_an_invalid_rollout_is_refused_immediately(client, scenario, change, code):
    answer = client.post(f"{scenario}/simulate", json=SHORT | change)
    assert answer.json()["code"] == code


def test_a_job_of_another_kind_has_no_preview(client):
    video = {"scene": "tiny", "camera": "front", "width": 64, "end_us": 100_000}
    job = finished(client, client.post("/v1/exports", json=video))
    answer = client.get(f"/v1/jobs/{job['job_id']}/preview", params={"camera": "front"})
    assert answer.json()["code"] == ErrorCode.INVALID_REQUEST
