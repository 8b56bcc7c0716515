from real2sim_proto import CONVENTIONS, DRIVE_SUBPROTOCOL
from real2sim_proto.scenes import ServerInfo


def test_server_publishes_versions_limits_and_conventions(start_worker):
    client = start_worker(worker_id="w7", max_sessions=3)
    info = ServerInfo.model_validate(client.get("/v1/server").json())
    assert info.worker_id == "w7"
    assert info.limits.max_sessions == 3
    assert info.subprotocols == [DRIVE_SUBPROTOCOL]
    assert info.conventions == CONVENTIONS


def test_server_reports_the_backend_and_the_reason(client):
    device = client.get("/v1/server").json()["device"]
    assert device["backend"] == "cpu"
    assert "REAL2SIM_BACKEND" in device["reason"]


def test_every_call_has_a_stable_operation_id_and_a_description(client):
    operations = [
        operation
        for path in client.get("/openapi.json").json()["paths"].values()
        for operation in path.values()
    ]
    ids = [operation["operationId"] for operation in operations]
    assert len(set(ids)) == len(ids)
    assert {"scenes-render", "scenarios-edit", "health-ready"} <= set(ids)
    assert all(operation.get("description") for operation in operations)
