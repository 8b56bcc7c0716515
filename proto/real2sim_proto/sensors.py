"""Lenses, shutters and image effects of cameras; LiDARs, radars and their clouds."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from .base import Identifier, Model, Pose

ShutterDirection = Literal[
    "global", "top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"
]

Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Angle = Annotated[float, Field(gt=0, le=math.pi)]


class PinholeLens(Model):
    """No distortion."""

    model: Literal["pinhole"] = "pinhole"


class BrownConradyLens(Model):
    """OpenCV's rational model; refused if the image extends beyond its valid radius."""

    model: Literal["brown_conrady"] = "brown_conrady"
    radial: tuple[Number, Number, Number, Number, Number, Number] = Field(
        default=(0.0,) * 6, description="k1 to k6"
    )
    tangential: tuple[Number, Number] = Field(default=(0.0,) * 2, description="p1, p2")
    thin_prism: tuple[Number, Number, Number, Number] = Field(
        default=(0.0,) * 4, description="s1 to s4"
    )


class FisheyeLens(Model):
    """OpenCV's fisheye (Kannala and Brandt)."""

    model: Literal["fisheye"] = "fisheye"
    k: tuple[Number, Number, Number, Number] = Field(default=(0.0,) * 4, description="k1 to k4")
    max_angle: Angle | None = Field(
        default=None,
        description=(
            "largest angle from the optical axis that is imaged [rad]; null: the limit of the model"
        ),
    )


class OmnidirectionalLens(Model):
    """OpenCV's omnidirectional model (Mei and Rives)."""

    model: Literal["omnidirectional"] = "omnidirectional"
    xi: float = Field(default=1.0, ge=0, le=100)
    k: tuple[Number, Number] = Field(default=(0.0,) * 2, description="k1, k2")
    p: tuple[Number, Number] = Field(default=(0.0,) * 2, description="p1, p2")


class FThetaLens(Model):
    """NVIDIA's f-theta model; radii in focal lengths of K: a polynomial in pixels is divided by
    fx (or, taking radii, its coefficient of power n multiplied by fx^n)."""

    model: Literal["f_theta"] = "f_theta"
    polynomial: list[Number] = Field(
        default=[0.0, 1.0],
        min_length=2,
        max_length=6,
        description="coefficients, starting with the constant (0)",
    )
    reference: Literal["angle", "radius"] = Field(
        default="angle", description="argument of the polynomial"
    )
    linear: tuple[Number, Number, Number] = Field(default=(1.0, 0.0, 0.0), description="c, d, e")
    max_angle: Angle = Field(default=math.pi, description="[rad]")


LensSpec = Annotated[
    PinholeLens | BrownConradyLens | FisheyeLens | OmnidirectionalLens | FThetaLens,
    Field(discriminator="model"),
]


class ShutterSpec(Model):
    """Readout of an image. The time of the image is the middle of the readout."""

    direction: ShutterDirection = "global"
    readout_us: int = Field(
        default=0,
        ge=0,
        le=200_000,
        description="time from the first to the last line; 0 for a global shutter",
    )


Pixels = Annotated[float, Field(ge=-1e6, le=1e6)]
Row = tuple[Pixels, Pixels, Pixels]


class OpticsSpec(Model):
    """A custom camera in place of a recorded one."""

    K: tuple[Row, Row, Row] | None = Field(
        default=None, description="3x3 at the recorded size [px]; default: the camera's own"
    )
    lens: LensSpec = PinholeLens()
    shutter: ShutterSpec = ShutterSpec()


Optics = Literal["pinhole", "recorded"] | OpticsSpec

Gain = Annotated[float, Field(ge=0.05, le=20)]


class NoiseSpec(Model):
    """Sensor noise in linear light, where white is 1, with variance `photon` x signal + `read`^2;
    reproducible for the same seed, camera and time."""

    photon: float = Field(default=0.0, ge=0, le=0.1)
    read: float = Field(default=0.0, ge=0, le=0.5)
    seed: int = Field(default=0, ge=0, lt=2**63)


class MotionBlurSpec(Model):
    """The mean light of several rendered images within an exposure; costs `samples` times as
    much."""

    exposure_us: int = Field(ge=1, le=200_000)
    samples: int = Field(default=5, ge=2, le=16)


class CameraEffects(Model):
    """Effects of a real camera on its colour images, applied in this order; off by default."""

    motion_blur: MotionBlurSpec | None = None
    vignetting: tuple[float, float, float] | None = Field(
        default=None,
        description=(
            "a, b, c: light is multiplied by 1 + a r^2 + b r^4 + c r^6, at least 0; r is "
            "the distance from the image centre over half the diagonal"
        ),
    )
    exposure_ev: float = Field(default=0.0, ge=-10, le=10, description="multiplies light by 2^ev")
    white_balance: tuple[Gain, Gain, Gain] | None = Field(
        default=None, description="gains of linear red, green and blue"
    )
    noise: NoiseSpec | None = None
    tone_curve: list[Annotated[float, Field(ge=0, le=1)]] | None = Field(
        default=None,
        min_length=2,
        max_length=64,
        description="output values for evenly spaced inputs from 0 to 1; non-decreasing",
    )
    jpeg_quality: int | None = Field(
        default=None, ge=1, le=100, description="quality of the camera's own compression"
    )

    @model_validator(mode="after")
    def _fits(self) -> CameraEffects:
        curve = self.tone_curve
        if curve is not None and any(b < a for a, b in pairwise(curve)):
            raise ValueError(f"tone_curve {curve!r} falls somewhere")
        if self.vignetting is not None and max(map(abs, self.vignetting)) > 10:
            raise ValueError(f"vignetting {self.vignetting!r} has numbers beyond 10")
        return self

    @property
    def names(self) -> list[str]:
        """Names of the enabled effects, in order."""
        return [name for name in type(self).model_fields if getattr(self, name) not in (None, 0.0)]


# --- LiDARs and radars ------------------------------------------------------------------------

MAX_LIDARS = 8
MAX_RADARS = 8
MAX_RAYS = 1 << 19
"""Maximum number of rays per sweep; the densest current sensors use less than half."""

CloudCodec = Literal["raw", "deflate"]
CloudModality = Literal["lidar", "radar"]
CloudFrame = Literal["sensor", "vehicle"]
LidarField = Literal["intensity", "ring", "time_us", "return_number", "instance"]
LIDAR_FIELDS: tuple[LidarField, ...] = (
    "intensity",
    "ring",
    "time_us",
    "return_number",
    "instance",
)

Numbers = Annotated[list[float], Field(min_length=1, max_length=MAX_RAYS)]
Span = tuple[float, float]
Hertz = Annotated[float, Field(ge=0.1, le=1000)]


# --- models of LiDARs -------------------------------------------------------------------------


class SpinningBeams(Model):
    """Rows that rotate about the sensor's z axis; angles in degrees."""

    kind: Literal["spinning"]
    elevation_deg: Numbers = Field(description="elevation of each row")
    azimuth_offset_deg: Numbers | None = Field(
        default=None, description="azimuth offset of each row from its column; default: 0"
    )
    columns: int = Field(description="azimuth steps per turn")
    rate_hz: float = Field(default=10.0, description="turns per second")
    clockwise: bool = Field(default=True, description="rotates clockwise, seen from above")
    start_deg: float = Field(default=180.0, description="azimuth at the start of a turn")
    field_of_view_deg: float = Field(
        default=360.0, description="azimuth range covered, about the middle of the turn"
    )


class TableBeams(Model):
    """Beams listed individually."""

    kind: Literal["table"]
    azimuth_deg: Numbers
    elevation_deg: Numbers
    time_us: Numbers


class GridBeams(Model):
    """A solid-state sensor that scans evenly spaced rows, top row first, left to right."""

    kind: Literal["grid"]
    azimuth_deg: Span = Field(description="from edge to edge")
    elevation_deg: Span = Field(description="from edge to edge")
    columns: Annotated[int, Field(ge=1, le=MAX_RAYS)]
    rows: Annotated[int, Field(ge=1, le=MAX_RAYS)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0


class RosetteBeams(Model):
    """Two prisms that rotate at different speeds: petals about the sensor's x axis."""

    kind: Literal["rosette"]
    radius_deg: Annotated[float, Field(gt=0, lt=90)]
    turns_per_minute: Span = Field(description="rotation rates of the two prisms")
    rays: Annotated[int, Field(ge=1, le=MAX_RAYS)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0


class DetectionSpec(Model):
    """Detection model of a LiDAR."""

    range_m: float = Field(
        default=120.0, description="range at which `reflectivity` is just detected"
    )
    reflectivity: float = Field(default=0.1, description="0 to 1")
    loss: float = Field(default=0.0, description="share of rays lost independent of the target")
    softness: float = Field(
        default=0.25,
        description="width of the transition from detected to lost, relative to the limiting power",
    )


class LidarModel(Model):
    """A custom LiDAR."""

    name: Annotated[str, Field(min_length=1, max_length=64)]
    source: str = Field(default="", description="source of the figures")
    beams: Annotated[
        SpinningBeams | TableBeams | GridBeams | RosetteBeams, Field(discriminator="kind")
    ]
    T_vehicle_lidar: list[list[float]] | None = Field(
        default=None, description="4x4; default: 0.9 m before and 1.73 m above the rear axle"
    )
    range_m: Span = Field(
        default=(0.5, 120.0), description="smallest and largest range of a return"
    )
    divergence_mrad: Span = Field(
        default=(0.0, 0.0), description="full angle at 1/e^2 of the power, horizontal, vertical"
    )
    returns: int = Field(default=1, description="1, 2 (first, last) or 3 (and the strongest)")
    pulse_m: float = Field(default=0.4, description="echoes closer than this merge")
    range_noise_m: float = Field(default=0.0, description="standard deviation")
    detection: DetectionSpec = DetectionSpec()


# --- models of radars -------------------------------------------------------------------------

Degrees = Annotated[float, Field(gt=0, le=360)]
Metres = Annotated[float, Field(gt=0, le=2000)]


class RadarModel(Model):
    """A radar that resolves range, azimuth, elevation and radial velocity. The defaults are those
    of a 77 GHz mid-range front radar."""

    range_m: tuple[float, float] = Field(default=(0.5, 160.0), description="smallest, largest")
    field_of_view_deg: tuple[Degrees, Degrees] = Field(
        default=(120.0, 20.0), description="horizontal, vertical"
    )
    range_resolution_m: Annotated[float, Field(ge=0.02, le=50)] = Field(
        default=0.4, description="size of a resolution cell"
    )
    azimuth_resolution_deg: Annotated[float, Field(ge=0.1, le=90)] = 1.5
    elevation_resolution_deg: Annotated[float, Field(ge=0.1, le=180)] = Field(
        default=20.0,
        description="as large as the field of view if elevation is not resolved",
    )
    velocity_resolution_mps: Annotated[float, Field(ge=0.01, le=50)] = 0.1
    max_velocity_mps: Annotated[float, Field(gt=0, le=500)] | None = Field(
        default=None, description="velocities beyond this wrap around; null: no ambiguity"
    )
    detection_range_m: Metres = Field(
        default=140.0, description="range at which a target of 10 m^2 is just detected"
    )
    min_rcs_dbsm: Annotated[float, Field(ge=-100, le=60)] = Field(
        default=-20.0, description="weaker targets are never reported"
    )
    ray_spacing_deg: Annotated[float, Field(ge=0.05, le=10)] = Field(
        default=0.4, description="spacing of the rays that search for targets"
    )
    range_noise_m: Annotated[float, Field(ge=0, le=10)] = Field(
        default=0.05, description="standard deviation"
    )
    azimuth_noise_deg: Annotated[float, Field(ge=0, le=10)] = 0.15
    velocity_noise_mps: Annotated[float, Field(ge=0, le=10)] = 0.03
    clutter_rate: Annotated[float, Field(ge=0, le=10_000)] = Field(
        default=2.0, description="mean number of false detections per scan"
    )
    ghost_rate: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.0,
        description="share of detections of objects that also appear at twice their range",
    )

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        near, far = self.range_m
        if not 0 <= near < far <= 2000:
            raise ValueError(f"range_m {self.range_m!r} must rise within 0 to 2000 m")
        rays = self.ray_count
        if rays > MAX_RAYS:
            raise ValueError(
                f"{rays:,} rays of {self.ray_spacing_deg} degrees; allowed are {MAX_RAYS:,}"
            )
        if self.field_of_view_deg[1] > 179:
            raise ValueError("field_of_view_deg: 179 degrees of elevation at most")
        return self

    @property
    def ray_count(self) -> int:
        """Number of rays per scan."""
        wide, high = (max(round(a / self.ray_spacing_deg), 1) for a in self.field_of_view_deg)
        return int(wide * high)


# --- sensors of a session ---------------------------------------------------------------------

PERIOD = "time between clouds; a multiple of dt_us; default: the least such that a sweep fits into"


class LidarSpec(Model):
    """One LiDAR of an observation."""

    lidar: Identifier = Field(description="sensor name, also of its clouds")
    model: Identifier | LidarModel | None = Field(
        default=None,
        description="name in the catalogue, or a model; default: the value of `lidar`",
    )
    pose: Pose | None = Field(
        default=None, description="T_vehicle_lidar, x forward; default: the model's pose"
    )
    rate_hz: Hertz | None = Field(
        default=None,
        description="sweeps per second; ray times scale with it; default: the model's rate",
    )
    period_us: int | None = Field(default=None, gt=0, le=2**40, description=PERIOD)
    frame: CloudFrame = Field(default="sensor", description="frame of the points")
    compensated: bool = Field(
        default=True,
        description=(
            "points are relative to the sensor pose at the cloud's time; false: to the "
            "sensor pose when each ray was fired"
        ),
    )
    fields: list[LidarField] = Field(
        default=list(LIDAR_FIELDS),
        max_length=len(LIDAR_FIELDS),
        description="columns in addition to `points`",
    )
    codec: CloudCodec = "raw"

    @field_validator("fields")
    @classmethod
    def _fields_differ(cls, fields: list[LidarField]) -> list[LidarField]:
        if len(set(fields)) != len(fields):
            raise ValueError(f"fields {fields!r} repeat one")
        return fields


class RadarSpec(Model):
    """One radar of an observation."""

    radar: Identifier = Field(description="sensor name, also of its clouds")
    model: Identifier | RadarModel | None = Field(
        default=None,
        description="name in the catalogue, or a model; default: the value of `radar`",
    )
    pose: Pose | None = Field(
        default=None,
        description="T_vehicle_radar, x along its axis; default: 3.6 m before the rear axle, 0.5 "
        "m high, forward",
    )
    period_us: int | None = Field(
        default=None,
        gt=0,
        le=2**40,
        description="time between scans; a multiple of dt_us, and dt_us by default",
    )
    frame: CloudFrame = Field(default="sensor", description="frame of the points")
    codec: CloudCodec = "raw"


# --- clouds -----------------------------------------------------------------------------------


class CloudField(Model):
    """A column of a cloud, with one or more numbers per point."""

    name: str
    dtype: Literal["float32", "uint8", "uint16", "int32"]
    width: int = Field(default=1, ge=1, le=16, description="values per point")


__all__ = [
    "LIDAR_FIELDS",
    "MAX_LIDARS",
    "MAX_RADARS",
    "MAX_RAYS",
    "CloudCodec",
    "CloudField",
    "CloudFrame",
    "CloudModality",
    "DetectionSpec",
    "GridBeams",
    "LidarField",
    "LidarModel",
    "LidarSpec",
    "RadarModel",
    "RadarSpec",
    "RosetteBeams",
    "SpinningBeams",
    "TableBeams",
]
