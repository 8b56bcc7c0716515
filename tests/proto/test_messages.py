from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from real2sim_proto import conventions, drive, operations
from real2sim_proto.base import Pose, invalid_reason
from real2sim_proto.drive import CLIENT_MESSAGE
from real2sim_proto.errors import HTTP_STATUS, ErrorCode, Problem, title_of
from real2sim_proto.operations import OPERATION
from real2sim_proto.plans import PLAN, Control
from real2sim_proto.scenarios import OperationBatch
from real2sim_proto.sessions import SessionInfo


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_non_finite_actions_are_refused(value):
    with pytest.raises(ValidationError):
        PLAN.validate_python({"kind": "control", "acceleration": value, "steering": 0.0})
    with pytest.raises(ValidationError):
        PLAN.validate_python({"kind": "trajectory", "times_us": [1], "poses": [[value, 0, 0]]})


def test_a_plan_accepts_arrays_and_lists():
    lists = {"kind": "trajectory", "times_us": [1, 2], "poses": [[0, 0, 0], [1, 0, 0]]}
    arrays = {
        "kind": "trajectory",
        "times_us": np.array([1, 2]),
        "poses": np.array([[0.0, 0, 0], [1, 0, 0]]),
    }
    assert PLAN.validate_python(lists) == PLAN.validate_python(arrays)


@pytest.mark.parametrize(
    ("times", "poses"),
    [([1, 2], [[0, 0, 0]]), ([2, 1], [[0, 0, 0]] * 2), ([1, 1], [[0, 0, 0]] * 2), ([], [])],
)
def test_plans_of_wrong_length_or_order_are_refused(times, poses):
    with pytest.raises(ValidationError):
        PLAN.validate_python({"kind": "trajectory", "times_us": times, "poses": poses})


def test_a_non_unit_quaternion_is_refused_with_its_length():
    with pytest.raises(ValidationError, match="has length 2"):
        Pose(position=(0, 0, 0), quaternion=(2, 0, 0, 0))


def test_quaternions_are_normalised_to_full_precision():
    pose = Pose(position=(0, 0, 0), quaternion=(0.7071, 0, 0, 0.7071))
    assert sum(q * q for q in pose.quaternion) == pytest.approx(1.0, abs=1e-15)


def test_unknown_fields_are_refused():
    with pytest.raises(ValidationError, match="extra"):
        OPERATION.validate_python({"op": "delete", "object_id": "car_1", "force": True})


def test_unknown_operations_are_refused_with_the_supported_ones():
    with pytest.raises(ValidationError, match="translate"):
        OPERATION.validate_python({"op": "explode", "object_id": "car_1"})


@pytest.mark.parametrize("object_id", ["", "../etc", "a b", "x" * 81, "-car"])
def test_invalid_ids_are_refused(object_id):
    with pytest.raises(ValidationError):
        operations.Delete(object_id=object_id)


def test_a_rotation_with_a_zero_axis_is_refused():
    with pytest.raises(ValidationError, match="no direction"):
        operations.Rotate(object_id="car_1", angle=1.0, axis=(0, 0, 0))


def test_batches_must_have_1_to_256_operations():
    one = {"op": "delete", "object_id": "a"}
    with pytest.raises(ValidationError):
        OperationBatch.model_validate({"operations": [one] * 257})
    with pytest.raises(ValidationError):
        OperationBatch.model_validate({"operations": []})


def test_messages_are_discriminated_by_type():
    message = CLIENT_MESSAGE.validate_python(
        {"v": 1, "type": "hello", "id": 1, "protocols": ["real2sim.v1.msgpack"]}
    )
    assert isinstance(message, drive.Hello)


def test_a_message_of_another_protocol_version_is_refused():
    with pytest.raises(ValidationError):
        CLIENT_MESSAGE.validate_python({"v": 2, "type": "bye", "id": 1})


def test_the_mismatch_message_names_both_versions():
    sentence = conventions.protocol_mismatch(["real2sim.v9.msgpack"])
    assert "real2sim.v9.msgpack" in sentence
    assert conventions.DRIVE_SUBPROTOCOL in sentence


def test_every_error_code_has_an_http_error_status():
    assert set(HTTP_STATUS) == set(ErrorCode)
    assert all(400 <= status < 600 for status in HTTP_STATUS.values())


def test_a_problem_keeps_unknown_members():
    problem = Problem.model_validate(
        {
            "title": title_of(ErrorCode.STALE_REVISION),
            "status": 412,
            "code": "STALE_REVISION",
            "detail": "d",
            "missed": [1],
        }
    )
    assert problem.title == "Stale revision"
    assert problem.model_extra == {"missed": [1]}


def test_duplicate_modalities_of_a_sensor_are_refused():
    with pytest.raises(ValidationError, match="repeat"):
        drive.SensorSpec(camera="front", modalities=["rgb", "rgb"])


def test_unknown_members_are_ignored_from_workers_and_refused_from_clients():
    answer = {"v": 1, "type": "edited", "id": 1, "revision": 2, "extra": "good"}
    assert drive.SERVER_MESSAGE.validate_python(answer).revision == 2
    with pytest.raises(ValidationError, match="extra"):
        CLIENT_MESSAGE.validate_python({"v": 1, "type": "bye", "id": 1, "extra": "good"})


@pytest.mark.parametrize(
    ("changes", "reasons"),
    [
        ({"steering": float("nan")}, ["must be a finite number, got NaN"]),
        ({"steering": -float("inf")}, ["must be a finite number, got -Infinity"]),
        ({"steering": 2.0}, ["must be less than or equal to 1.6, got 2.0"]),
        ({"steering": "left"}, ["must be a valid number, unable to parse string as a number"]),
        ({"gear": "R"}, ["must be 'drive' or 'reverse', got 'R'"]),
        ({"gear": "R" * 100}, ["must be 'drive' or 'reverse'"]),
        ({"brake": 1}, ["is not a known member"]),
    ],
)
def test_the_reason_for_an_invalid_value_is_a_sentence(changes, reasons):
    with pytest.raises(ValidationError) as caught:
        Control.model_validate({"acceleration": 0.0, "steering": 0.0} | changes)
    found = [invalid_reason(problem) for problem in caught.value.errors()]
    assert [said[: len(reason)] for said, reason in zip(found, reasons, strict=True)] == reasons


def test_a_missing_value_is_named_and_a_secret_is_not_shown():
    with pytest.raises(ValidationError) as caught:
        drive.Hello.model_validate({"token": 12345678, "id": 1})
    reasons = {p["loc"]: invalid_reason(p) for p in caught.value.errors()}
    assert reasons[("protocols",)] == "is missing"
    assert reasons[("token",)] == "must be a valid string"


def test_the_repr_of_a_message_does_not_reveal_tokens():
    resume = drive.Resume(token="hunter2")
    hello = drive.Hello(id=1, protocols=["p"], token="hunter2", resume=resume)
    forked = drive.Forked.model_construct(token="hunter2", session_id="w0.1")
    welcome = drive.Welcome.model_construct(resume_token="hunter2")
    info = SessionInfo.model_construct(token="hunter2")
    assert "hunter2" not in repr([hello, resume, forked, welcome, info])
