"""Options of an episode: sensors, vehicle, traffic, time limits, contact, scoring."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .base import Codec, Identifier, Microseconds, Modality, Model
from .sensors import MAX_LIDARS, MAX_RADARS, CameraEffects, LidarSpec, Optics, RadarSpec
from .storyboard import Storyboard

MAX_SENSORS = 16
MAX_DRIVERS = 64

Metre = Annotated[float, Field(ge=0, le=1e4)]
Speed = Annotated[float, Field(ge=0, le=150)]
Seconds = Annotated[float, Field(gt=0, le=3600)]


class SensorSpec(Model):
    """One camera of an observation."""

    camera: Identifier
    modalities: list[Modality] = Field(default=["rgb"], min_length=1, max_length=6)
    width: int | None = Field(default=None, ge=16, le=8192, description="[px]; default: recorded")
    codec: Codec = Field(
        default="raw", description="encoding of rgb; other modalities are raw or png"
    )
    quality: int = Field(default=90, ge=1, le=100, description="JPEG quality")
    period_us: int | None = Field(
        default=None, gt=0, description="time between frames; a multiple of dt_us; default: dt_us"
    )

    detail: Literal["auto", "full"] = Field(
        default="auto",
        description=(
            "'auto': images of at most 16,384 pixels are rendered from merged Gaussians, "
            "antialiased, in a fraction of the time; 'full': from all Gaussians, as larger "
            "images always are"
        ),
    )

    optics: Optics = Field(
        default="pinhole",
        description=(
            "'pinhole': without distortion, as scenes are trained; 'recorded': lens and "
            "shutter of the log's camera, if the scene has them; or a lens and shutter "
            "given here"
        ),
    )
    effects: CameraEffects | None = Field(
        default=None, description="camera effects on colour images; default: none"
    )

    @model_validator(mode="after")
    def _modalities_differ(self) -> SensorSpec:
        if len(set(self.modalities)) != len(self.modalities):
            raise ValueError(f"modalities {self.modalities!r} repeat one")
        return self


class VehicleSpec(Model):
    """Mass, tyres and load of the controlled vehicle; used by `dynamic_bicycle` and in contact.

    Cornering coefficients are lateral force per load and slip angle. The defaults are those of a
    mid-size car: 0.2 per degree at the front and more at the rear, which gives an understeer of
    about 1.2 degrees per g (Gillespie 1992, Fundamentals of Vehicle Dynamics, ch. 6).
    """

    mass: Annotated[float, Field(gt=0, le=1e5)] = Field(default=1500.0, description="[kg]")
    yaw_inertia: Annotated[float, Field(gt=0, le=1e7)] | None = Field(
        default=None, description="[kg m^2]; default: mass x front x rear distance of the centre"
    )
    front_load: Annotated[float, Field(gt=0.1, lt=0.9)] = Field(
        default=0.56, description="fraction of the weight on the front axle at rest"
    )
    centre_height: Annotated[float, Field(ge=0, le=4)] = Field(
        default=0.55, description="height of the centre of mass above the ground [m]"
    )
    friction: Annotated[float, Field(gt=0, le=2)] = Field(
        default=0.9, description="friction of tyre on road: 0.9 dry asphalt, 0.5 wet, 0.2 snow"
    )
    front_cornering: Annotated[float, Field(gt=1, le=100)] = Field(
        default=11.5, description="cornering coefficient of the front axle [1/rad]"
    )
    rear_cornering: Annotated[float, Field(gt=1, le=100)] = Field(
        default=15.0, description="cornering coefficient of the rear axle [1/rad]"
    )


class ActuatorSpec(Model):
    """Actuator dynamics between a command and the wheels.

    The default lags are those of nuPlan's kinematic bicycle.
    """

    steering_delay_us: int = Field(default=0, ge=0, le=1_000_000, description="dead time")
    steering_lag: Annotated[float, Field(ge=0, le=2)] = Field(
        default=0.05, description="time constant of the first-order lag [s]"
    )
    drive_delay_us: int = Field(default=0, ge=0, le=1_000_000, description="dead time")
    drive_lag: Annotated[float, Field(ge=0, le=2)] = Field(
        default=0.2, description="time constant of the first-order lag [s]"
    )
    foreseen: bool = Field(
        default=True,
        description="trajectory trackers compensate lag and dead time; false: they ignore both",
    )


class SuspensionSpec(Model):
    """Suspension of the body.

    The defaults are those of a mid-size car: it pitches by about 1.4 degrees per g of braking and
    rolls by about 3.9 degrees per g in bends. Ride frequencies and damping: Gillespie 1992,
    Fundamentals of Vehicle Dynamics, ch. 5.
    """

    front_frequency: Annotated[float, Field(ge=0.5, le=10)] = Field(
        default=1.3, description="ride frequency of the front axle [Hz]"
    )
    rear_frequency: Annotated[float, Field(ge=0.5, le=10)] = Field(
        default=1.5, description="ride frequency of the rear axle [Hz]"
    )
    damping: Annotated[float, Field(ge=0.05, le=0.95)] = Field(
        default=0.3, description="fraction of critical damping"
    )
    track: Annotated[float, Field(ge=0.3, le=5)] = Field(
        default=1.58, description="track width, left to right wheels [m]"
    )
    pitch_resistance: Annotated[float, Field(ge=0, le=0.95)] = Field(
        default=0.3, description="share of the load transfer carried by links instead of springs"
    )
    roll_resistance: Annotated[float, Field(ge=0, le=0.95)] = Field(
        default=0.4, description="share of the load transfer carried by anti-roll bars"
    )


class EgoSpec(Model):
    """Dynamics of the controlled vehicle."""

    dynamics: Literal["kinematic_bicycle", "dynamic_bicycle"] = "kinematic_bicycle"
    tracker: Literal["pursuit", "lqr", "ilqr", "perfect"] = Field(
        default="pursuit",
        description="trajectory controller; 'perfect' places the ego on the plan",
    )
    tracker_version: Literal[1, 2] = Field(
        default=2,
        description=(
            "2: trackers extrapolate acceleration and direction before a plan's first pose, "
            "and use the previous plan if a plan has a single pose; 1: they do neither, for "
            "recordings without this option"
        ),
    )
    wheelbase: Annotated[float, Field(ge=0.5, le=20)] = Field(default=2.8, description="[m]")
    max_steer: Annotated[float, Field(gt=0, le=1.4)] = Field(default=0.6, description="[rad]")
    max_steer_rate: Annotated[float, Field(gt=0, le=10)] = Field(default=0.8, description="[rad/s]")
    max_acceleration: Annotated[float, Field(gt=0, le=50)] = Field(
        default=4.0, description="[m/s^2]"
    )
    max_braking: Annotated[float, Field(gt=0, le=50)] = Field(default=8.0, description="[m/s^2]")
    max_speed: Annotated[float, Field(gt=0, le=150)] = Field(default=60.0, description="[m/s]")
    max_reverse_speed: Annotated[float, Field(ge=0, le=20)] = Field(
        default=5.0,
        description=(
            "top speed in reverse gear, engaged by commands and by plans that lead "
            "backwards; 0: no reverse gear [m/s]"
        ),
    )
    vehicle: VehicleSpec = VehicleSpec()
    actuators: ActuatorSpec = ActuatorSpec()
    suspension: SuspensionSpec | None = Field(
        default=SuspensionSpec(),
        description=(
            "body and cameras pitch when accelerating and braking and roll in bends; None: rigid"
        ),
    )


# --- other road users -------------------------------------------------------------------------


class ReplayDriver(Model):
    """Moves as recorded, or as edited; does not react to others."""

    kind: Literal["log"] = "log"


class ConstantVelocityDriver(Model):
    """Keeps its initial velocity; does not react to others."""

    kind: Literal["constant_velocity"] = "constant_velocity"


class IdmParameters(Model):
    """Parameters of the intelligent driver model (Treiber et al. 2000)."""

    desired_speed: Speed | None = Field(
        default=None, description="[m/s]; default: its highest recorded speed"
    )
    headway: Seconds = Field(default=1.5, description="desired time headway T [s]")
    gap: Metre = Field(default=2.0, description="gap s0 at rest, bumper to bumper [m]")
    acceleration: Annotated[float, Field(gt=0, le=10)] = Field(default=1.5, description="[m/s^2]")
    braking: Annotated[float, Field(gt=0, le=10)] = Field(
        default=2.0, description="comfortable deceleration [m/s^2]"
    )
    lateral: Annotated[float, Field(gt=0, le=10)] = Field(
        default=2.5, description="lateral acceleration that limits the speed in bends [m/s^2]"
    )


class IdmDriver(IdmParameters):
    """Follows a path and the lead vehicle (Treiber et al. 2000)."""

    kind: Literal["idm"] = "idm"
    path: Literal["recorded", "route"] = Field(
        default="recorded",
        description=(
            "'recorded': its own path, recorded or edited; 'route': its lane along the "
            "ego's route, in the direction it faces"
        ),
    )


class LaneDriver(IdmParameters):
    """Follows the lanes of the scene's map and the lead vehicle, and changes lanes if beneficial
    (MOBIL: Kesting, Treiber and Helbing 2007)."""

    kind: Literal["lanes"] = "lanes"
    desired_speed: Speed | None = Field(
        default=None,
        description=(
            "[m/s]; default: the lane's limit, or its highest recorded speed if the map has none"
        ),
    )
    politeness: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.2, description="politeness p: weight of others' gains and losses"
    )
    threshold: Annotated[float, Field(ge=0, le=5)] = Field(
        default=0.1, description="smallest gain for a lane change [m/s^2]"
    )
    safe_braking: Annotated[float, Field(gt=0, le=9)] = Field(
        default=4.0,
        description="hardest braking that a lane change may impose on the vehicle behind [m/s^2]",
    )
    change_time: Annotated[float, Field(ge=0.5, le=20)] = Field(
        default=4.0, description="duration of a lane change [s]"
    )
    changes: bool = Field(default=True, description="False: it never changes lanes")


class CutInDriver(Model):
    """Drives next to the ego's route, then cuts in close ahead of the ego."""

    kind: Literal["cut_in"] = "cut_in"
    offset: Annotated[float, Field(ge=-20, le=20)] = Field(
        default=3.5,
        description="lateral offset of its lane from the route, positive to the left [m]",
    )
    gap: Metre = Field(
        default=6.0, description="distance from the ego's front to its rear when it cuts in [m]"
    )
    delay: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=1.0, description="earliest time after the start to cut in [s]"
    )
    duration: Seconds = Field(default=1.5, description="duration of the lane change [s]")
    speed_change: Annotated[float, Field(ge=-50, le=50)] = Field(
        default=-2.0,
        description="its speed after the lane change, relative to the ego's at that time [m/s]",
    )


class HardBrakeDriver(Model):
    """Follows its recorded path and brakes to a stop in front of the ego."""

    kind: Literal["hard_brake"] = "hard_brake"
    delay: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=1.0, description="earliest time after the start to brake [s]"
    )
    gap: Metre = Field(default=15.0, description="brakes once the ego is within this distance [m]")
    braking: Annotated[float, Field(gt=0, le=12)] = Field(default=7.0, description="[m/s^2]")


class JunctionCrossingDriver(Model):
    """Crosses the ego's route, timed to arrive together with the ego."""

    kind: Literal["junction_crossing"] = "junction_crossing"
    ahead: Metre = Field(
        default=30.0, description="crossing point along the route from the start [m]"
    )
    angle: Annotated[float, Field(ge=-3.2, le=3.2)] = Field(
        default=1.57, description="its heading relative to the route at the crossing point [rad]"
    )
    speed: Annotated[float, Field(gt=0, le=50)] = Field(
        default=8.0, description="speed at the start [m/s]"
    )
    max_speed: Annotated[float, Field(gt=0, le=60)] = Field(default=15.0, description="[m/s]")
    acceleration: Annotated[float, Field(gt=0, le=10)] = Field(
        default=3.0,
        description="largest acceleration or braking to arrive together with the ego [m/s^2]",
    )
    commit: Seconds = Field(
        default=1.0, description="time before the crossing when it stops reacting to the ego [s]"
    )


class ExternalDriver(Model):
    """Driven by another client with `agent` messages."""

    kind: Literal["external"] = "external"


AgentDriver = Annotated[
    ReplayDriver
    | ConstantVelocityDriver
    | IdmDriver
    | LaneDriver
    | CutInDriver
    | HardBrakeDriver
    | JunctionCrossingDriver
    | ExternalDriver,
    Field(discriminator="kind"),
]


class LaneSpec(Model):
    """A lane along the ego's route in which road users appear and disappear."""

    offset: Annotated[float, Field(ge=-20, le=20)] = Field(
        default=0.0,
        description="lateral offset of its centre from the route, positive to the left [m]",
    )
    oncoming: bool = Field(default=False, description="against the direction of the route")


class SpawnSpec(Model):
    """Road users that appear and disappear along the ego's route; sampled with the episode's seed.

    A road user appears at the edge of the stretch around the ego, where the road is free, and is
    removed `margin` beyond the stretch. It looks like a vehicle of the scene and drives by IDM.
    """

    density: Annotated[float, Field(gt=0, le=200)] = Field(
        default=20.0, description="density of each lane [vehicles per km]"
    )
    lanes: list[LaneSpec] = Field(default=[LaneSpec()], min_length=1, max_length=8)
    ahead: Annotated[float, Field(ge=20, le=500)] = Field(
        default=60.0,
        description="distance ahead of the ego to the end of the stretch, along the route [m]",
    )
    behind: Annotated[float, Field(ge=10, le=500)] = Field(
        default=40.0, description="distance behind the ego to the start of the stretch [m]"
    )
    margin: Annotated[float, Field(ge=5, le=200)] = Field(
        default=15.0, description="distance beyond either end at which a road user is removed [m]"
    )
    gap: Annotated[float, Field(ge=2, le=200)] = Field(
        default=12.0,
        description="free distance ahead and behind required to spawn a road user [m]",
    )
    most: int = Field(default=16, ge=1, le=64, description="largest number at the same time")
    speed_spread: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.15,
        description="desired speeds are drawn within this fraction of the driver's desired speed",
    )
    looks: list[Identifier] = Field(
        default_factory=list,
        max_length=64,
        description="objects of the scene to copy the appearance of; default: all its vehicles",
    )
    driver: IdmDriver = Field(
        default=IdmDriver(),
        description="driver; its desired speed defaults to the highest of the recorded drive",
    )


class AgentsSpec(Model):
    """Drivers of the other road users."""

    default: Literal["log", "constant_velocity", "idm", "lanes"] = Field(
        default="log",
        description="driver of moving objects that `drivers` does not name; 'lanes' needs a map",
    )
    drivers: dict[Identifier, AgentDriver] = Field(default_factory=dict, max_length=MAX_DRIVERS)
    ego_off_log: Literal["replay", "idm"] = Field(
        default="replay",
        description=(
            "objects that replay the log keep replaying it, or switch to IDM once the ego "
            "is `off_log_distance` from its recorded position"
        ),
    )
    off_log_distance: Metre = Field(default=3.0, description="[m]")
    spawn: SpawnSpec | None = Field(
        default=None,
        description="road users that appear and leave along the route; None: no such traffic",
    )


# --- randomization ----------------------------------------------------------------------------


class StartRandomization(Model):
    """Uniform offsets of the ego's initial position and speed, up to these values in either
    direction."""

    longitudinal: Annotated[float, Field(ge=0, le=50)] = Field(
        default=0.0, description="along the recorded drive [m]"
    )
    lateral: Annotated[float, Field(ge=0, le=3)] = Field(default=0.0, description="[m]")
    heading: Annotated[float, Field(ge=0, le=0.5)] = Field(default=0.0, description="[rad]")
    speed: Annotated[float, Field(ge=0, le=20)] = Field(
        default=0.0, description="clipped at standstill [m/s]"
    )


Fraction = Annotated[float, Field(ge=0, le=0.9)]


class TrafficRandomization(Model):
    """Parameters of IDM drivers: each is multiplied by a factor sampled once per object, uniform
    within 1 plus or minus this value."""

    desired_speed: Fraction = 0.0
    headway: Fraction = 0.0
    gap: Fraction = 0.0
    acceleration: Fraction = 0.0
    braking: Fraction = 0.0


class EstimateRandomization(Model):
    """Errors of the ego's localization, normal with these standard deviations.

    Observations then contain the estimate: `ego`, `route`, `command` and `T_world_sensor` of
    frames. Images, contact and scores use the true state, which `ego_truth` has in `privileged`
    episodes. Plans in the vehicle's frame start from the true pose.
    """

    position: Annotated[float, Field(ge=0, le=5)] = Field(
        default=0.0, description="along each of world x and y [m]"
    )
    heading: Annotated[float, Field(ge=0, le=0.5)] = Field(default=0.0, description="[rad]")
    speed: Annotated[float, Field(ge=0, le=5)] = Field(default=0.0, description="[m/s]")
    correlation: Annotated[float, Field(ge=0, le=600)] = Field(
        default=0.0,
        description=(
            "correlation time of the errors (Gauss-Markov) [s]; 0: independent at every step"
        ),
    )


class Randomization(Model):
    """Values sampled with the episode's seed; none by default."""

    start: StartRandomization = StartRandomization()
    traffic: TrafficRandomization = TrafficRandomization()
    estimate: EstimateRandomization = EstimateRandomization()
    latency_us: int = Field(
        default=0,
        ge=0,
        le=5_000_000,
        description="upper limit of a uniform random delay added to the latency of every plan",
    )


# --- time, contact, scoring -------------------------------------------------------------------


class LatencySpec(Model):
    """Delay before a plan takes effect; the previous plan applies meanwhile."""

    model: Literal["zero", "fixed", "measured"] = Field(
        default="zero",
        description="'measured': the time from sending obs to receiving the action",
    )
    fixed_us: int = Field(default=0, ge=0, le=5_000_000, description="latency for 'fixed'")
    longest_us: int = Field(
        default=5_000_000, ge=0, le=60_000_000, description="upper limit for 'measured'"
    )


class ContactSpec(Model):
    """Definition of contact, and its consequences if `on_collision` is 'continue'."""

    restitution: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.1, description="ratio of separation speed to approach speed along the normal"
    )
    friction: Annotated[float, Field(ge=0, le=2)] = Field(
        default=0.5, description="largest ratio of tangential to normal impulse"
    )
    background: bool = Field(
        default=False, description="include walls, poles and other background geometry"
    )
    swept: bool = Field(
        default=True,
        description=(
            "detect contact between two clock steps; false: only overlap at a clock step, "
            "for recordings without this option"
        ),
    )
    masses: dict[Identifier, Annotated[float, Field(gt=0, le=1e6)]] = Field(
        default_factory=dict, description="[kg] by object; default: by category and box"
    )
    weighed_by_height: bool = Field(
        default=True,
        description=(
            "derive the mass of people from their height unless `masses` has it; false: "
            "from the volume of their box, three to five times too much, for recordings "
            "without this option"
        ),
    )
    pulse: bool = Field(
        default=True,
        description=(
            "impacts last as long as masses and stiffness determine, about a tenth of a "
            "second; false: instantaneous, for recordings without this option"
        ),
    )
    residual_crush: bool = Field(
        default=True,
        description=(
            "crushed structure does not push back until it is crushed further, force acts "
            "at the centre of the yielding area, and vehicles have published moments of "
            "inertia; false: none of this, for recordings without this option"
        ),
    )
    distributed: bool = Field(
        default=True,
        description=(
            "distribute the contact force along the faces that still approach each other, "
            "with a normal that turns with the struck face; false: apply it at one point, "
            "for recordings without this option"
        ),
    )
    progressive: bool = Field(
        default=True,
        description=(
            "force between two vehicles grows with approach speed and progressively with "
            "depth, so slow impacts last longer; needs `distributed`; false: depth alone, "
            "for recordings without this option"
        ),
    )
    dents: bool = Field(
        default=True,
        description="images show struck objects deformed by the material point method",
    )
    breakage: bool = Field(
        default=True,
        description=(
            "sheet metal of struck vehicles folds, their lamps and glass break, and "
            "fragments stay on the road; false: dents only, for recordings without this "
            "option"
        ),
    )


class ScoringSpec(Model):
    """Inputs of the scores in addition to the log."""

    speed_limit: Speed | None = Field(default=None, description="[m/s]; None: unknown")
    corridor: Annotated[float, Field(gt=0.5, le=50)] = Field(
        default=3.5, description="half width of the drivable corridor along the route [m]"
    )
    lane: Annotated[float, Field(gt=0.5, le=10)] = Field(
        default=1.75, description="half width of the ego's lane along the route [m]"
    )


ENDLESS_US = 3_600_000_000
"""Length of episodes beyond the log without a horizon, unless the client ends them: an hour."""

MAX_HORIZON = 1_000_000


class ResetSpec(Model):
    """Options of an episode."""

    @model_validator(mode="before")
    @classmethod
    def _default_horizon(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping) or fields.get("horizon") is not None:
            return fields
        dt_us = fields.get("dt_us", 100_000)
        if fields.get("beyond_log", "end") == "end" or not isinstance(dt_us, int) or dt_us < 1:
            return fields
        return {**fields, "horizon": min(ENDLESS_US // dt_us, MAX_HORIZON)}

    seed: int = Field(
        default=0,
        ge=0,
        lt=2**63,
        description=(
            "seed of the draws of `randomization` and `agents.spawn`; has no effect without them"
        ),
    )
    randomization: Randomization = Randomization()
    start_us: Microseconds | None = Field(default=None, description="default: start of the log")
    dt_us: int = Field(default=100_000, ge=1_000, le=1_000_000, description="clock step")
    horizon: int | None = Field(
        default=None,
        ge=1,
        le=MAX_HORIZON,
        description=(
            "number of steps, at most 1,000,000. Default: to the end of the log, which is "
            "also the limit if `beyond_log` is 'end'; an hour otherwise"
        ),
    )
    beyond_log: Literal["end", "loop", "extend"] = Field(
        default="end",
        description=(
            "behaviour for a horizon beyond the recording: 'end' refuses it; 'loop' returns "
            "the ego to the start of the recorded drive each time it reaches the end, with "
            "an event `looped`; 'extend' continues the route, its last bend fading into a "
            "straight line"
        ),
    )
    warmup_us: int = Field(
        default=0,
        ge=0,
        description="the ego replays the recording for this long and ignores plans",
    )
    sensors: list[SensorSpec] = Field(
        default_factory=list, max_length=MAX_SENSORS, description="cameras"
    )
    lidars: list[LidarSpec] = Field(default_factory=list, max_length=MAX_LIDARS)
    radars: list[RadarSpec] = Field(default_factory=list, max_length=MAX_RADARS)
    ego: EgoSpec = EgoSpec()
    action: Literal["trajectory", "control", "pose"] = "trajectory"
    agents: AgentsSpec = AgentsSpec()
    storyboard: Storyboard | None = Field(
        default=None,
        description=(
            "storyboard that moves its entities, which then have no driver of `agents`. "
            "Default: the scenario's; a storyboard without entities runs none"
        ),
    )
    privileged: bool = Field(
        default=False,
        description="fill `agents` of every observation, and `lanes` if the scene has a map",
    )
    deadline_ms: int | None = Field(
        default=None,
        ge=1,
        le=3_600_000,
        description="wall-clock time limit of a plan; None: no limit",
    )
    on_timeout: Literal["hold_plan", "brake", "pause", "fail"] = Field(
        default="hold_plan", description="behaviour if a plan misses its deadline"
    )
    wall_clock_s: Annotated[float, Field(gt=0, le=86_400)] | None = Field(
        default=None, description="wall-clock time limit of the episode [s]"
    )
    latency: LatencySpec = LatencySpec()
    on_collision: Literal["terminate", "continue"] = Field(
        default="terminate", description="'continue' exchanges momentum and continues"
    )
    contact: ContactSpec = ContactSpec()
    scoring: ScoringSpec = ScoringSpec()
