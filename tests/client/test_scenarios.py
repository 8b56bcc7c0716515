"""Scenario handles against a worker with a history."""

from __future__ import annotations

import asyncio

import pytest

import real2sim

from .fake_worker import FakeWorker

pytestmark = pytest.mark.network


def test_edits_send_the_revision_of_the_handle(worker: FakeWorker) -> None:
    with real2sim.connect(worker.url) as client:
        scenario = client.scenarios.create(scene="street")
        scenario.objects["car_3"].translate(y=3.2)
        scenario.objects["car_3"].rotate(angle=0.1)
    edits = [headers for method, path, headers in worker.requests if path.endswith("operations")]
    assert [headers["if-match"] for headers in edits] == ['"r0"', '"r1"']
    assert scenario.revision == 2


def test_each_method_sends_its_operation(worker: FakeWorker) -> None:
    with real2sim.connect(worker.url) as client:
        car = client.scenarios.create(scene="street").objects["car_3"]
        car.translate(x=1.0, frame="object")
        car.rotate(angle=0.5, axis=(1.0, 0.0, 0.0))
        car.scale(z=2.0, anchor="centre")
        car.set_pose(position=(1.0, 2.0, 3.0))
        car.duplicate(new_id="second", y=4.0)
        car.delete()
    sent = [entry["operations"][0] for entry in worker.log]
    assert [op["op"] for op in sent] == [
        "translate",
        "rotate",
        "scale",
        "set_pose",
        "duplicate",
        "delete",
    ]
    assert (sent[0]["x"], sent[0]["frame"]) == (1.0, "object")
    assert (sent[1]["angle"], sent[1]["axis"]) == (0.5, [1.0, 0.0, 0.0])
    assert (sent[2]["z"], sent[2]["anchor"]) == (2.0, "centre")
    assert sent[3]["pose"]["position"] == [1.0, 2.0, 3.0]
    assert (sent[4]["new_id"], sent[4]["y"]) == ("second", 4.0)


def test_a_duplicate_has_its_own_handle(worker: FakeWorker) -> None:
    with real2sim.connect(worker.url) as client:
        scenario = client.scenarios.create(scene="street")
        copy = scenario.objects["car_3"].duplicate(y=4.0)
        copy.delete()
        assert copy.object_id == "car_3_copy1"
        assert list(scenario.objects) == ["car_3"]


def test_a_stale_handle_is_refused_with_the_missed_operations(worker: FakeWorker) -> None:
    with real2sim.connect(worker.url) as client:
        scenario = client.scenarios.create(scene="street")
        worker.record([{"op": "translate", "object_id": "car_3", "x": 1.0}])
        with pytest.raises(real2sim.StaleRevisionError) as caught:
            scenario.objects["car_3"].delete()
        assert caught.value.revision == 1
        assert [op.op for entry in caught.value.missed for op in entry.operations] == ["translate"]
        scenario.refresh().objects["car_3"].delete()
    assert "car_3" not in worker.objects


def test_an_unknown_object_suggests_similar_names(worker: FakeWorker) -> None:
    with real2sim.connect(worker.url) as client:
        scenario = client.scenarios.create(scene="street")
        with pytest.raises(KeyError, match="did you mean car_3"):
            scenario.objects["car_33"]


@pytest.mark.parametrize(
    ("operation", "sentence"),
    [
        ({"op": "explode", "object_id": "car_3"}, "explode"),
        ({"op": "translate", "object_id": "car_3", "x": float("nan")}, "finite"),
        ({"op": "rotate", "object_id": "car_3", "angle": 1.0, "axis": (0, 0, 0)}, "no direction"),
    ],
)
def test_invalid_operations_are_refused_before_sending(
    worker: FakeWorker, operation: dict[str, object], sentence: str
) -> None:
    with real2sim.connect(worker.url) as client:
        scenario = client.scenarios.create(scene="street")
        with pytest.raises(ValueError, match=sentence):
            scenario.apply([operation])
    assert worker.log == []


def test_the_async_client_edits_in_the_same_way(worker: FakeWorker) -> None:
    async def edit() -> None:
        async with real2sim.connect_async(worker.url) as client:
            scenario = await client.scenarios.create(scene="street")
            copy = await scenario.objects["car_3"].duplicate(y=4.0)
            await copy.translate(x=1.0)
            assert (copy.object_id, scenario.revision) == ("car_3_copy1", 2)
            worker.record([])
            with pytest.raises(real2sim.StaleRevisionError):
                await copy.delete()

    asyncio.run(edit())
