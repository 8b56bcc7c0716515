"""Messages of AlpaSim's driver and renderer, and a pinhole camera in the f-theta model.

Field names and numbers follow AlpaSim's ``egodriver.proto``, ``common.proto`` and
``sensorsim.proto``, version 0. Readers skip the fields that are omitted here. Enumerations are
plain numbers, which have the same wire format. The classes live in a separate pool, so a process
can also load AlpaSim's own classes.
"""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from ._session_state import Matrix

DRIVER = "egodriver.EgodriverService"
RENDERER = "nre.grpc.protos.sensorsim.SensorsimService"
MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""Message limit of AlpaSim's own channels."""

COMMON = {
    "Empty": "",
    "AvailableScenesReturn": "string* scene_ids 1",
    "SessionRequestStatus": "",
    "Quat": "float w 1, float x 2, float y 3, float z 4",
    "Vec3": "float x 1, float y 2, float z 3",
    "Pose": "common.Vec3 vec 1, common.Quat quat 2",
    "DynamicState": (
        "common.Vec3 angular_velocity 1, common.Vec3 linear_velocity 2, "
        "common.Vec3 linear_acceleration 3, common.Vec3 angular_acceleration 4"
    ),
    "PoseAtTime": "common.Pose pose 1, fixed64 timestamp_us 2",
    "Trajectory": "common.PoseAtTime* poses 1",
    "APIVersion": "uint32 major 1, uint32 minor 2, uint32 patch 3",
    "VersionId": ("string version_id 1, string git_hash 2, common.APIVersion grpc_api_version 3"),
}
NRE = "nre.grpc.protos.sensorsim"
"""Package of the renderer's messages."""
SENSORSIM = {
    "LinearCde": "double linear_c 1, double linear_d 2, double linear_e 3",
    "FthetaCameraParam": (
        "double principal_point_x 1, double principal_point_y 2, int32 reference_poly 3, "
        "double* pixeldist_to_angle_poly 4, double* angle_to_pixeldist_poly 5, "
        f"double max_angle 6, {NRE}.LinearCde linear_cde 7"
    ),
    "OpenCVPinholeCameraParam": (
        "double principal_point_x 1, double principal_point_y 2, "
        "double focal_length_x 3, double focal_length_y 4, double* radial_coeffs 5, "
        "double* tangential_coeffs 6, double* thin_prism_coeffs 7"
    ),
    "OpenCVFisheyeCameraParam": "double principal_point_x 1, double principal_point_y 2",
    "BivariateWindshieldModelParameters": "int32 reference_poly 1",
    "CameraSpec": (
        f"{NRE}.FthetaCameraParam ftheta_param 2, "
        f"{NRE}.OpenCVPinholeCameraParam opencv_pinhole_param 3, "
        f"{NRE}.OpenCVFisheyeCameraParam opencv_fisheye_param 4, "
        "string logical_id 5, uint32 resolution_h 7, uint32 resolution_w 8, int32 shutter_type 9, "
        f"{NRE}.BivariateWindshieldModelParameters bivariate_windshield_model_param 10"
    ),
    "AvailableCamera": (
        f"{NRE}.CameraSpec intrinsics 1, common.Pose rig_to_camera 2, string logical_id 3"
    ),
    "AvailableCamerasRequest": "string scene_id 1",
    "AvailableCamerasReturn": f"{NRE}.AvailableCamera* available_cameras 1",
    "AvailableTrajectoriesRequest": "string scene_id 1",
    "AvailableTrajectory": "common.Trajectory trajectory 2",
    "AvailableTrajectoriesReturn": f"{NRE}.AvailableTrajectory* available_trajectories 1",
    "AvailableEgoMasksReturn": "",
    "LoadedSceneEntry": (
        "string scene_id 1, uint64 loaded_instance_count 2, uint64 reusable_instance_count 3"
    ),
    "LoadedScenesReturn": f"{NRE}.LoadedSceneEntry* scenes 1, uint64 loaded_instance_capacity 2",
    "PosePair": "common.Pose start_pose 1, common.Pose end_pose 2",
    "DynamicObject": f"string track_id 1, {NRE}.PosePair pose_pair 2",
    "RGBRenderRequest": (
        f"string scene_id 1, uint32 resolution_h 2, uint32 resolution_w 3, "
        f"{NRE}.CameraSpec camera_intrinsics 4, fixed64 frame_start_us 5, fixed64 frame_end_us 6, "
        f"{NRE}.PosePair sensor_pose 7, {NRE}.DynamicObject* dynamic_objects 8, "
        "int32 image_format 9, float image_quality 10, bool insert_ego_mask 11"
    ),
    "RGBRenderReturn": "bytes image_bytes 1",
    "BatchRGBRenderRequestItem": f"string camera_name 1, {NRE}.RGBRenderRequest request 2",
    "BatchRGBRenderRequest": f"{NRE}.BatchRGBRenderRequestItem* items 1",
    "BatchRGBRenderReturnItem": (
        f"string camera_name 1, {NRE}.RGBRenderReturn result 2, bool success 3, "
        "string error_message 4"
    ),
    "BatchRGBRenderReturn": f"{NRE}.BatchRGBRenderReturnItem* items 1",
    "LidarRenderRequest": "string scene_id 1",
    "LidarRenderReturn": "uint32 num_points 3",
    "AggregatedRenderRequest": (
        f"{NRE}.RGBRenderRequest* rgb_requests 1, {NRE}.LidarRenderRequest* lidar_requests 2"
    ),
    "AggregatedRenderReturn": f"{NRE}.RGBRenderReturn* rgb_returns 1",
}
GLOBAL_SHUTTER = 5
EGODRIVER = {
    "Route": "common.Vec3* waypoints 1, fixed64 timestamp_us 2",
    "VehicleDefinition": f"{NRE}.AvailableCamera* available_cameras 3",
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
"""Fields as TYPE NAME NUMBER; a star means repeated. Nested messages are listed at the top level,
which has the same wire format."""

DRIVER_METHODS = {
    "start_session": ("DriveSessionRequest", "SessionRequestStatus"),
    "close_session": ("DriveSessionCloseRequest", "Empty"),
    "submit_image_observation": ("RolloutCameraImage", "Empty"),
    "submit_egomotion_observation": ("RolloutEgoTrajectory", "Empty"),
    "submit_route": ("RouteRequest", "Empty"),
    "drive": ("DriveRequest", "DriveResponse"),
    "get_version": ("Empty", "VersionId"),
}
"""Request and reply types of the driver's methods, which Real2Sim calls."""

RENDERER_METHODS = {
    "render_rgb": ("RGBRenderRequest", "RGBRenderReturn"),
    "batch_render_rgb": ("BatchRGBRenderRequest", "BatchRGBRenderReturn"),
    "render_aggregated": ("AggregatedRenderRequest", "AggregatedRenderReturn"),
    "render_lidar": ("LidarRenderRequest", "LidarRenderReturn"),
    "get_version": ("Empty", "VersionId"),
    "get_available_scenes": ("Empty", "AvailableScenesReturn"),
    "get_loaded_scenes": ("Empty", "LoadedScenesReturn"),
    "get_available_cameras": ("AvailableCamerasRequest", "AvailableCamerasReturn"),
    "get_available_trajectories": ("AvailableTrajectoriesRequest", "AvailableTrajectoriesReturn"),
    "get_available_ego_masks": ("Empty", "AvailableEgoMasksReturn"),
}
"""Request and reply types of the renderer's methods, which Real2Sim serves."""


@functools.cache
def messages() -> SimpleNamespace:
    """The message classes by name. Raises ImportError without protobuf."""
    pb2 = importlib.import_module("google.protobuf.descriptor_pb2")
    pool = importlib.import_module("google.protobuf.descriptor_pool").DescriptorPool()
    factory = importlib.import_module("google.protobuf.message_factory")
    classes: dict[str, Any] = {}
    packages = {"common": COMMON, NRE: SENSORSIM, "egodriver": EGODRIVER}
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
        repeated, kind = kind.endswith("*"), kind.removesuffix("*")
        field = field_class(name=name, number=int(number))
        field.label = field_class.LABEL_REPEATED if repeated else field_class.LABEL_OPTIONAL
        scalar = getattr(field_class, f"TYPE_{kind.upper()}", None)
        if scalar is not None:
            field.type = scalar
        else:
            field.type = field_class.TYPE_MESSAGE
            field.type_name = "." + kind
        yield field


# A pinhole camera in AlpaSim's f-theta model, which drivers that rectify images require. A pinhole
# maps an angle t off the axis to the radius f tan(t); polynomials fit both directions.

ODD_TERMS = 10
"""Number of odd terms of the polynomials. Their error is below 1/50 pixel for 120 degrees."""
SAMPLES = 2000


@dataclass(frozen=True)
class Ftheta:
    """An f-theta camera.

    Attributes:
        angle_to_pixels: coefficients from power 0 on; [rad] to [px].
        pixels_to_angle: coefficients of the inverse; [px] to [rad].
        max_angle: angle between an image corner and the optical axis [rad].
        stretch: ratio of the pixel scales along x and y.
    """

    angle_to_pixels: list[float]
    pixels_to_angle: list[float]
    max_angle: float
    stretch: float

    @classmethod
    def of(cls, K: Matrix, width: int, height: int) -> Ftheta:
        """The f-theta model of a pinhole camera with ``K`` [3, 3] and image size [px]."""
        focal, stretch = float(K[1, 1]), float(K[0, 0] / K[1, 1])
        x = max(K[0, 2], width - K[0, 2]) / K[0, 0]
        y = max(K[1, 2], height - K[1, 2]) / K[1, 1]
        reach = math.hypot(x, y)
        tangents = np.linspace(0.0, reach, SAMPLES)
        angles = np.arctan(tangents)
        return cls(
            angle_to_pixels=_odd_polynomial(angles, focal * tangents),
            pixels_to_angle=_odd_polynomial(focal * tangents, angles),
            max_angle=math.atan(reach),
            stretch=stretch,
        )


def _odd_polynomial(x: Matrix, y: Matrix) -> list[float]:
    """Coefficients from power 0 up; those of even powers are 0."""
    powers = np.arange(1, 2 * ODD_TERMS, 2)
    scale = float(x[-1])
    found = np.linalg.lstsq((x[:, None] / scale) ** powers, y, rcond=None)[0]
    coefficients = np.zeros(2 * ODD_TERMS)
    coefficients[powers] = found / scale**powers
    return [float(c) for c in coefficients]
