"""LiDAR and radar sensors of a session."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

import real2sim
from real2sim_proto import decode
from real2sim_server.render.cast.call import warm_up_casting
from real2sim_server.world.recording import load_recording
from tests.waiting import wait_until

pytestmark = pytest.mark.network

FAN = {
    "name": "fan",
    "beams": {"kind": "spinning", "elevation_deg": [-4, -2, 0, 2], "columns": 90, "rate_hz": 10},
    "range_noise_m": 0.02,
    "range_m": [0.5, 80],
}
TOP = {"lidar": "top", "model": FAN}
EPISODE = {"dt_us": 50_000, "lidars": [TOP], "radars": [{"radar": "corner"}]}


@pytest.fixture(autouse=True, scope="module")
def casting_kernels():
    """Cache the kernels on disk, so that no reset waits for them."""
    warm_up_casting()


def columns(cloud):
    """Columns of a raw cloud."""
    found, begin = {}, 0
    for field in cloud["fields"]:
        dtype = np.dtype(field["dtype"])
        size = cloud["count"] * field["width"] * dtype.itemsize
        part = np.frombuffer(cloud["data"][begin : begin + size], dtype)
        found[field["name"]] = part.reshape(cloud["count"], -1) if field["width"] > 1 else part
        begin += size
    assert begin == len(cloud["data"])
    return found


def test_a_slower_lidar_is_delivered_when_its_sweep_is_complete(planner):
    seen = [planner.reset(**EPISODE)] + [planner.act(step) for step in range(3)]
    names = [[cloud["sensor"] for cloud in obs["clouds"]] for obs in seen]
    assert names == [["top", "corner"], ["corner"], ["top", "corner"], ["corner"]]
    sweep = seen[2]["clouds"][0]
    assert sweep["t_us"] == seen[2]["t_us"]
    assert sweep["modality"] == "lidar"
    times = columns(sweep)["time_us"]
    assert -100_000 <= times.min() < times.max() <= 0


def test_points_match_the_objects_at_the_sensor_pose(planner):
    obs = planner.reset(**EPISODE, privileged=True)
    cloud = obs["clouds"][0]
    found = columns(cloud)
    assert found["points"].shape == (cloud["count"], 3)
    assert cloud["count"] <= 4 * 90
    assert set(found["return_number"]) == {1}
    world = found["points"] @ cloud["T_world_sensor"][:3, :3].T + cloud["T_world_sensor"][:3, 3]
    centres = np.array([agent["position"] for agent in obs["agents"]])
    apart = np.linalg.norm(world[found["instance"] > 0][:, None] - centres, axis=-1).min(axis=1)
    assert len(apart)
    assert apart.max() < 3.0


def test_the_same_episode_gives_the_same_clouds(site, join):
    drives = []
    for _ in range(2):
        planner = join(site.create())
        seen = [planner.reset(**EPISODE, seed=5), planner.act(0), planner.act(1)]
        drives.append([cloud["data"] for obs in seen for cloud in obs["clouds"]])
    assert drives[0] == drives[1]
    other = join(site.create()).reset(**EPISODE, seed=6)["clouds"][0]["data"]
    assert other != drives[0][0]


def test_observations_without_lidars_or_radars_have_no_clouds(planner):
    assert "clouds" not in planner.reset(dt_us=50_000)
    assert "clouds" not in planner.act(0)


def test_deflated_columns_equal_raw_columns(planner):
    raw = planner.reset(**EPISODE)["clouds"][0]
    packed = planner.reset(dt_us=50_000, lidars=[TOP | {"codec": "deflate"}])["clouds"][0]
    data = zlib.decompress(packed["data"])
    begin = 0
    for field, column in zip(packed["fields"], columns(raw).values(), strict=True):
        size = column.nbytes
        planes = np.frombuffer(data[begin : begin + size], np.uint8)
        again = np.ascontiguousarray(planes.reshape(column.itemsize, -1).T).tobytes()
        assert again == column.tobytes(), field
        begin += size


def test_rendering_a_cloud_does_not_advance_time(site, planner):
    obs = planner.reset(dt_us=50_000)
    view = planner.ask("render", lidars=[TOP | {"fields": ["ring"]}], radars=[])
    assert [field["name"] for field in view["clouds"][0]["fields"]] == ["points", "ring"]
    body = {"lidars": [TOP]}
    answer = site.call("POST", planner.info, "/render", json=body)
    assert answer.headers["content-type"] == "application/msgpack"
    assert decode(answer.content)["clouds"][0]["count"] > 0
    assert planner.act(0)["step"] == obs["step"] + 1


def test_rest_lists_the_lidar_and_radar_models(site):
    about = site.http.get("/v1/server").json()
    assert "os1-128" in about["lidar_models"]
    assert "corner" in about["radar_models"]
    assert about["limits"]["max_rays_per_step"] == 1 << 19


ROWS = {"kind": "spinning", "elevation_deg": [0.0] * 1000, "columns": 1000}
TABLE = {"kind": "table", "azimuth_deg": [0.0], "elevation_deg": [0.0], "time_us": [0.0]}


@pytest.mark.parametrize(
    ("lidar", "said"),
    [
        ({"lidar": "none"}, "no LiDAR 'none' in the catalogue; it has"),
        ({"lidar": "top", "model": FAN | {"beams": ROWS}}, "allowed are 1 to 524,288 rays"),
        ({"lidar": "top", "model": FAN | {"returns": 9}}, "returns must be 1, 2 or 3"),
        ({"lidar": "top", "model": FAN, "period_us": 70_000}, "not a multiple of dt_us"),
        ({"lidar": "top", "model": FAN, "period_us": 50_000}, "a sweep takes"),
        ({"lidar": "corner", "model": FAN}, "one name"),
    ],
)
def test_an_invalid_sensor_is_refused_with_the_reason(planner, lidar, said):
    radars = [{"radar": "corner"}]
    error = planner.reset(dt_us=50_000, lidars=[lidar], radars=radars)
    assert (error["type"], error["code"]) == ("error", "INVALID_REQUEST")
    assert said in error["detail"]
    assert planner.reset()["step"] == 0


def test_non_finite_beam_tables_are_refused(planner):
    model = FAN | {"beams": TABLE | {"time_us": [float("nan")]}}
    error = planner.reset(lidars=[{"lidar": "top", "model": model}])
    assert error["code"] == "BAD_MESSAGE"
    assert "finite" in error["detail"]


def test_rays_over_the_limit_of_the_worker_are_refused(planner):
    lidars = [{"lidar": f"top{k}", "model": "os1-128"} for k in range(5)]
    error = planner.reset(lidars=lidars)
    assert error["code"] == "INVALID_REQUEST"
    assert "655,360 rays in one go; this worker allows 524,288" in error["detail"]


def test_restoring_a_snapshot_restores_the_sweep(planner):
    planner.reset(**EPISODE)
    planner.act(0)
    there = planner.act(1)
    planner.ask("snapshot", name="here")
    planner.act(2)
    again = planner.ask("restore", name="here")
    assert [c["data"] for c in again["clouds"]] == [c["data"] for c in there["clouds"]]


def test_a_rebuilt_session_continues_with_the_same_sweep(site, join):
    whole = join(site.create())
    whole.reset(**EPISODE)
    expected = [whole.act(step) for step in range(4)][-1]["clouds"]
    info = site.create()
    first = join(info)
    first.reset(**EPISODE)
    for step in range(3):
        first.act(step)
    first.stack.close()
    session = site.session(info)
    wait_until(lambda: not session.connected, "the worker to notice")
    site.worker.sessions.evict(session)
    again = join(info)
    assert [c["data"] for c in again.act(3)["clouds"]] == [c["data"] for c in expected]


def test_recordings_store_clouds(site, tmp_path):
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        session.reset(dt_us=50_000, action="control", lidars=[TOP])
        for _ in range(2):
            obs = session.step({"kind": "control", "acceleration": 0.5, "steering": 0.0})
        path = session.save_recording(tmp_path / "drive.r2e", frames=True)
    kept = load_recording(path).frames
    assert sorted(kept) == ["frames/top/lidar/000000.cloud", "frames/top/lidar/000002.cloud"]
    found = dict(decode(kept["frames/top/lidar/000002.cloud"])["columns"])
    np.testing.assert_array_equal(found["points"], obs.lidar("top").points)


def test_sdk_clouds_are_saved_and_converted_to_world_coordinates(site, tmp_path):
    with real2sim.connect(site.url) as client, client.session(scene="tiny") as session:
        deflated = TOP | {"codec": "deflate", "frame": "vehicle"}
        session.reset(dt_us=50_000, lidars=[TOP], privileged=True)
        view = session.render(lidars=[deflated])
        plain = session.render(lidars=[TOP])
    packed, raw = view.lidar("top"), plain.lidar("top")
    np.testing.assert_allclose(packed.in_world(), raw.in_world(), atol=1e-4)
    for suffix in ("ply", "npz"):
        assert raw.save(tmp_path / f"sweep.{suffix}").stat().st_size > 12 * raw.count
    with pytest.raises(KeyError, match="top"):
        view.radar("top")


def test_semantic_images_label_the_ground(planner):
    sensors = [{"camera": "front", "modalities": ["semantic", "instance"], "detail": "full"}]
    frames = planner.reset(sensors=sensors)["frames"]
    semantic = np.frombuffer(frames[0]["data"], np.uint8)
    assert (semantic == 6).any()
    instance = np.frombuffer(frames[1]["data"], np.uint16)
    assert not (semantic[instance > 0] == 6).any()


def test_a_scenario_is_scanned_from_the_recording_vehicle(site):
    made = site.http.post("/v1/scenarios", json={"scene": "tiny"}).json()
    path = f"/v1/scenarios/{made['scenario_id']}/sweep"
    points = site.http.get(
        path,
        params={"lidar": "vlp-16", "t_us": 500_000},
        headers={"Accept": "application/octet-stream"},
    )
    assert points.status_code == 200
    rows = np.frombuffer(points.content, "<f4").reshape(-1, 4)
    cloud = decode(site.http.get(path, params={"lidar": "vlp-16", "t_us": 500_000}).content)
    assert len(rows) == cloud["count"] == int(points.headers["X-Real2Sim-Points"]) > 0
    np.testing.assert_array_equal(rows[:, 3], columns(cloud)["intensity"])
    for bad, status in (
        ({"lidar": "none"}, 422),
        ({"t_us": 2**61}, 422),
        ({"lidar": "vlp-16", "t_us": -5}, 422),
    ):
        assert site.http.get(path, params=bad).status_code == status
    picture = site.http.get(path, headers={"Accept": "image/png"})
    assert picture.status_code == 406
