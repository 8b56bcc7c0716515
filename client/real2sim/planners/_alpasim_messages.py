"""Messages of AlpaSim's EgodriverService, as far as a simulator needs them.

Names and numbers of fields are those of AlpaSim's ``egodriver.proto``, ``common.proto`` and
``sensorsim.proto``, version 0; what is left out here, readers skip. The classes live in a pool of
their own, so that a process may load AlpaSim's own ones too.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

SERVICE = "egodriver.EgodriverService"

COMMON = {
    "Empty": "",
    "SessionRequestStatus": "",
    "Quat": "float w 1, float x 2, float y 3, float z 4",
    "Vec3": "float x 1, float y 2, float z 3",
    "Pose": "common.Vec3 vec 1, common.Quat quat 2",
    "DynamicState": "common.Vec3 angular_velocity 1, common.Vec3 linear_velocity 2",
    "PoseAtTime": "common.Pose pose 1, fixed64 timestamp_us 2",
    "Trajectory": "common.PoseAtTime* poses 1",
    "VersionId": "string version_id 1, string git_hash 2",
}
SENSORSIM_PACKAGE = "nre.grpc.protos.sensorsim"
SENSORSIM = {
    "OpenCVPinholeCameraParam": (
        "double principal_point_x 1, double principal_point_y 2, "
        "double focal_length_x 3, double focal_length_y 4"
    ),
    "CameraSpec": (
        f"{SENSORSIM_PACKAGE}.OpenCVPinholeCameraParam opencv_pinhole_param 3, "
        "string logical_id 5, uint32 resolution_h 7, uint32 resolution_w 8, int32 shutter_type 9"
    ),
    "AvailableCamera": (
        f"{SENSORSIM_PACKAGE}.CameraSpec intrinsics 1, common.Pose rig_to_camera 2, "
        "string logical_id 3"
    ),
}
GLOBAL_SHUTTER = 5
EGODRIVER = {
    "Route": "common.Vec3* waypoints 1, fixed64 timestamp_us 2",
    "VehicleDefinition": f"{SENSORSIM_PACKAGE}.AvailableCamera* available_cameras 3",
    "RolloutSpec": "egodriver.VehicleDefinition vehicle 1",
    "DriveSessionRequest": (
        "string session_uuid 1, fixed64 random_seed 2, egodriver.RolloutSpec rollout_spec 5"
    ),
    "DriveSessionCloseRequest": "string session_uuid 1",
    "CameraImage": (
        "fixed64 frame_start_us 2, fixed64 frame_end_us 3, bytes image_bytes 4, string logical_id 5"
    ),
    "RolloutCameraImage": "string session_uuid 1, egodriver.CameraImage camera_image 3",
    "RolloutEgoTrajectory": (
        "string session_uuid 1, common.Trajectory trajectory 3, "
        "common.DynamicState* dynamic_states 5"
    ),
    "RouteRequest": "string session_uuid 1, egodriver.Route route 3",
    "DriveRequest": "string session_uuid 1, fixed64 time_now_us 3, fixed64 time_query_us 4",
    "DriveResponse": "common.Trajectory trajectory 2, bool terminate_session 4",
}
"""Fields as TYPE NAME NUMBER; a star means repeated. Nested messages stand side by side here, which
is the same on the wire."""

METHODS = {
    "start_session": ("DriveSessionRequest", "SessionRequestStatus"),
    "close_session": ("DriveSessionCloseRequest", "Empty"),
    "submit_image_observation": ("RolloutCameraImage", "Empty"),
    "submit_egomotion_observation": ("RolloutEgoTrajectory", "Empty"),
    "submit_route": ("RouteRequest", "Empty"),
    "drive": ("DriveRequest", "DriveResponse"),
    "get_version": ("Empty", "VersionId"),
}
"""Request and answer of the calls that are made."""


@functools.cache
def messages() -> SimpleNamespace:
    """The message classes by name. Raises ImportError without protobuf."""
    pb2 = importlib.import_module("google.protobuf.descriptor_pb2")
    pool = importlib.import_module("google.protobuf.descriptor_pool").DescriptorPool()
    factory = importlib.import_module("google.protobuf.message_factory")
    classes: dict[str, Any] = {}
    packages = {"common": COMMON, SENSORSIM_PACKAGE: SENSORSIM, "egodriver": EGODRIVER}
    for package, described in packages.items():
        file = pb2.FileDescriptorProto(name=f"{package}.proto", package=package, syntax="proto3")
        file.dependency.extend(f"{other}.proto" for other in packages if other != package)
        del file.dependency[list(packages).index(package) :]
        for name, fields in described.items():
            message = file.message_type.add(name=name)
            message.field.extend(_fields(pb2.FieldDescriptorProto, fields))
        pool.Add(file)
        for name in described:
            found = pool.FindMessageTypeByName(f"{package}.{name}")
            classes[name] = factory.GetMessageClass(found)
    return SimpleNamespace(**classes)


def _fields(field_class: Any, described: str) -> Iterator[Any]:
    for text in filter(None, described.split(", ")):
        kind, name, number = text.split()
        repeated = kind.endswith("*")
        field = field_class(name=name, number=int(number))
        field.label = field_class.LABEL_REPEATED if repeated else field_class.LABEL_OPTIONAL
        scalar = getattr(field_class, f"TYPE_{kind.upper()}", None)
        if scalar is not None:
            field.type = scalar
        else:
            field.type = field_class.TYPE_MESSAGE
            field.type_name = "." + kind.removesuffix("*")
        yield field
