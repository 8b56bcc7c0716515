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
    codec: Codec = Field(default="raw", description="of rgb; all else is raw or png")
    quality: int = Field(default=90, ge=1, le=100, description="of jpeg")
    period_us: int | None = Field(
        default=None, gt=0, description="time between frames; a multiple of dt_us; default: dt_us"
    )

    detail: Literal["auto", "full"] = Field(
        default="auto",
        description="'auto': images of at most 16,384 pixels are drawn from merged Gaussians, "
        "antialiased, in a fraction of the time; 'full': from all of them, as larger ones always",
    )

    optics: Optics = Field(
        default="pinhole",
        description="'pinhole': free of distortion, as scenes are trained; 'recorded': through the "
        "lens and shutter that the log's camera really had, where its scene knows them; or a lens "
        "and shutter given here",
    )
    effects: CameraEffects | None = Field(
        default=None, description="what a real camera does to its colour images; default: nothing"
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
        default=0.55, description="of the centre of mass above the ground [m]"
    )
    friction: Annotated[float, Field(gt=0, le=2)] = Field(
        default=0.9, description="tyre on road; 0.9 is dry asphalt, 0.5 wet, 0.2 snow"
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
        default=0.05, description="time constant of the first order [s]"
    )
    drive_delay_us: int = Field(default=0, ge=0, le=1_000_000, description="dead time")
    drive_lag: Annotated[float, Field(ge=0, le=2)] = Field(
        default=0.2, description="time constant of the first order [s]"
    )
    foreseen: bool = Field(
        default=True,
        description="trackers of trajectories know these figures and act in time; false: they "
        "steer as if there were neither lag nor dead time",
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
        default=0.3, description="of the critical one"
    )
    track: Annotated[float, Field(ge=0.3, le=5)] = Field(
        default=1.58, description="between left and right wheels [m]"
    )
    pitch_resistance: Annotated[float, Field(ge=0, le=0.95)] = Field(
        default=0.3, description="share of the load transfer that links carry past the springs"
    )
    roll_resistance: Annotated[float, Field(ge=0, le=0.95)] = Field(
        default=0.4, description="share of the load transfer that anti-roll bars carry"
    )


class EgoSpec(Model):
    """Dynamics of the controlled vehicle."""

    dynamics: Literal["kinematic_bicycle", "dynamic_bicycle"] = "kinematic_bicycle"
    tracker: Literal["pursuit", "lqr", "ilqr", "perfect"] = Field(
        default="pursuit", description="controller of trajectories; 'perfect' is put on the plan"
    )
    tracker_version: Literal[1, 2] = Field(
        default=2,
        description="2: trackers know a plan's acceleration and direction before its first pose, "
        "and plans of a single pose by the one before; 1: they do not, as in episodes recorded "
        "before this option was there",
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
        description="in reverse gear, which commands engage and plans that lead backwards; 0: it "
        "has none [m/s]",
    )
    vehicle: VehicleSpec = VehicleSpec()
    actuators: ActuatorSpec = ActuatorSpec()
    suspension: SuspensionSpec | None = Field(
        default=SuspensionSpec(),
        description="body and cameras pitch under drive and brakes and roll in bends; None: rigid",
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
    headway: Seconds = Field(default=1.5, description="T [s]")
    gap: Metre = Field(default=2.0, description="s0, bumper to bumper at rest [m]")
    acceleration: Annotated[float, Field(gt=0, le=10)] = Field(default=1.5, description="[m/s^2]")
    braking: Annotated[float, Field(gt=0, le=10)] = Field(
        default=2.0, description="comfortable [m/s^2]"
    )
    lateral: Annotated[float, Field(gt=0, le=10)] = Field(
        default=2.5, description="acceleration sideways that sets the speed in bends [m/s^2]"
    )


class IdmDriver(IdmParameters):
    """Follows a path and the lead vehicle (Treiber et al. 2000)."""

    kind: Literal["idm"] = "idm"
    path: Literal["recorded", "route"] = Field(
        default="recorded",
        description="'recorded': its own, as recorded or edited; 'route': the lane beside the "
        "ego's route in which it is, the way it faces",
    )


class LaneDriver(IdmParameters):
    """Follows the lanes of the scene's map and the lead vehicle, and changes lanes if beneficial
    (MOBIL: Kesting, Treiber and Helbing 2007)."""

    kind: Literal["lanes"] = "lanes"
    desired_speed: Speed | None = Field(
        default=None,
        description="[m/s]; default: the lane's limit, or its highest recorded speed where the map "
        "states none",
    )
    politeness: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.2, description="how much others' gains and losses count beside its own, p"
    )
    threshold: Annotated[float, Field(ge=0, le=5)] = Field(
        default=0.1, description="gain from which on it changes lanes [m/s^2]"
    )
    safe_braking: Annotated[float, Field(gt=0, le=9)] = Field(
        default=4.0, description="hardest that a change may make the one behind brake [m/s^2]"
    )
    change_time: Annotated[float, Field(ge=0.5, le=20)] = Field(
        default=4.0, description="of a change of lanes [s]"
    )
    changes: bool = Field(default=True, description="False: it keeps to its lane")


class CutInDriver(Model):
    """Drives next to the ego's route, then cuts in close ahead of the ego."""

    kind: Literal["cut_in"] = "cut_in"
    offset: Annotated[float, Field(ge=-20, le=20)] = Field(
        default=3.5, description="of its lane from the route, positive on the left [m]"
    )
    gap: Metre = Field(default=6.0, description="ego's front to its rear when it moves in [m]")
    delay: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=1.0, description="earliest time after the start to move in [s]"
    )
    duration: Seconds = Field(default=1.5, description="of the change of lanes [s]")
    speed_change: Annotated[float, Field(ge=-50, le=50)] = Field(
        default=-2.0, description="its speed afterwards, relative to the ego's at that time [m/s]"
    )


class HardBrakeDriver(Model):
    """Follows its recorded path and brakes to a stop in front of the ego."""

    kind: Literal["hard_brake"] = "hard_brake"
    delay: Annotated[float, Field(ge=0, le=3600)] = Field(
        default=1.0, description="earliest time after the start to brake [s]"
    )
    gap: Metre = Field(default=15.0, description="brakes once the ego is this near [m]")
    braking: Annotated[float, Field(gt=0, le=12)] = Field(default=7.0, description="[m/s^2]")


class JunctionCrossingDriver(Model):
    """Crosses the ego's route, timed to arrive together with the ego."""

    kind: Literal["junction_crossing"] = "junction_crossing"
    ahead: Metre = Field(
        default=30.0, description="crossing point along the route from the start [m]"
    )
    angle: Annotated[float, Field(ge=-3.2, le=3.2)] = Field(
        default=1.57, description="its heading against the route's there [rad]"
    )
    speed: Annotated[float, Field(gt=0, le=50)] = Field(
        default=8.0, description="at the start [m/s]"
    )
    max_speed: Annotated[float, Field(gt=0, le=60)] = Field(default=15.0, description="[m/s]")
    acceleration: Annotated[float, Field(gt=0, le=10)] = Field(
        default=3.0, description="to arrive with the ego; either way [m/s^2]"
    )
    commit: Seconds = Field(
        default=1.0, description="before the crossing it no longer reacts to the ego [s]"
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
        default=0.0, description="of its middle from the route, positive on the left [m]"
    )
    oncoming: bool = Field(default=False, description="against the direction of the route")


class SpawnSpec(Model):
    """Road users that appear and disappear along the ego's route; sampled with the episode's seed.

    A road user appears at the edge of the stretch around the ego, where the road is free, and is
    removed `margin` beyond the stretch. It looks like a vehicle of the scene and drives by IDM.
    """

    density: Annotated[float, Field(gt=0, le=200)] = Field(
        default=20.0, description="of each lane [vehicles per km]"
    )
    lanes: list[LaneSpec] = Field(default=[LaneSpec()], min_length=1, max_length=8)
    ahead: Annotated[float, Field(ge=20, le=500)] = Field(
        default=60.0, description="where the stretch ends, from the ego along the route [m]"
    )
    behind: Annotated[float, Field(ge=10, le=500)] = Field(
        default=40.0, description="where the stretch begins, behind the ego [m]"
    )
    margin: Annotated[float, Field(ge=5, le=200)] = Field(
        default=15.0, description="beyond either edge, after which one leaves [m]"
    )
    gap: Annotated[float, Field(ge=2, le=200)] = Field(
        default=12.0, description="free way before and behind where one appears [m]"
    )
    most: int = Field(default=16, ge=1, le=64, description="at a time")
    speed_spread: Annotated[float, Field(ge=0, le=0.9)] = Field(
        default=0.15, description="desired speeds are drawn within this fraction of the driver's"
    )
    looks: list[Identifier] = Field(
        default_factory=list,
        max_length=64,
        description="objects of the scene whose look they have; default: all its vehicles",
    )
    driver: IdmDriver = Field(
        default=IdmDriver(),
        description="its desired speed defaults to the highest one of the recorded drive",
    )


class AgentsSpec(Model):
    """Drivers of the other road users."""

    default: Literal["log", "constant_velocity", "idm", "lanes"] = Field(
        default="log",
        description="of objects that move and are not named in `drivers`; 'lanes' needs a map",
    )
    drivers: dict[Identifier, AgentDriver] = Field(default_factory=dict, max_length=MAX_DRIVERS)
    ego_off_log: Literal["replay", "idm"] = Field(
        default="replay",
        description="objects that repeat the log keep to it, or drive by IDM from the moment "
        "that the ego is `off_log_distance` from where it was recorded at that time",
    )
    off_log_distance: Metre = Field(default=3.0, description="[m]")
    spawn: SpawnSpec | None = Field(
        default=None, description="road users that come and go along the route; None: nobody does"
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
        default=0.0, description="never below standstill [m/s]"
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
        default=0.0, description="along x and y of the world each [m]"
    )
    heading: Annotated[float, Field(ge=0, le=0.5)] = Field(default=0.0, description="[rad]")
    speed: Annotated[float, Field(ge=0, le=5)] = Field(default=0.0, description="[m/s]")
    correlation: Annotated[float, Field(ge=0, le=600)] = Field(
        default=0.0,
        description="time in which errors change (Gauss-Markov) [s]; 0: anew at every step",
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
        description="a wait, uniform from 0 to this, is added to the latency of every plan",
    )


# --- time, contact, scoring -------------------------------------------------------------------


class LatencySpec(Model):
    """Delay before a plan takes effect; the previous plan applies meanwhile."""

    model: Literal["zero", "fixed", "measured"] = Field(
        default="zero", description="'measured': from sending obs to receiving the action"
    )
    fixed_us: int = Field(default=0, ge=0, le=5_000_000, description="of 'fixed'")
    longest_us: int = Field(default=5_000_000, ge=0, le=60_000_000, description="of 'measured'")


class ContactSpec(Model):
    """Definition of contact, and its consequences if `on_collision` is 'continue'."""

    restitution: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.1, description="separation speed per approach speed along the normal"
    )
    friction: Annotated[float, Field(ge=0, le=2)] = Field(
        default=0.5, description="tangential per normal impulse at most"
    )
    background: bool = Field(
        default=False, description="walls, poles and other parts of the background are hit too"
    )
    swept: bool = Field(
        default=True,
        description="contact between two instants of the clock counts too; false: only what "
        "overlaps at an instant, as in episodes recorded before this option was there",
    )
    masses: dict[Identifier, Annotated[float, Field(gt=0, le=1e6)]] = Field(
        default_factory=dict, description="[kg] by object; default: by category and box"
    )
    weighed_by_height: bool = Field(
        default=True,
        description="people weigh by their height, where `masses` names no mass; false: by the "
        "volume of their box, three to five times too much, as in episodes recorded before this "
        "option was there",
    )
    pulse: bool = Field(
        default=True,
        description="impacts take the time that masses and structures need, about a tenth of a "
        "second; false: all at once, as in episodes recorded before this option was there",
    )
    residual_crush: bool = Field(
        default=True,
        description="what an impact has crushed pushes no more until it is crushed further, force "
        "acts in the middle of what yields, and vehicles turn by published inertias; false: as in "
        "episodes recorded before this option was there",
    )
    distributed: bool = Field(
        default=True,
        description="force between two bodies acts wherever along their faces they still come "
        "nearer to each other, and its normal turns with the body whose face was struck; false: "
        "all of it at one place, as in episodes recorded before this option was there",
    )
    progressive: bool = Field(
        default=True,
        description="force between two vehicles grows with the speed at which they come nearer and "
        "progressively with depth, as that of their matter does, so that slow impacts last longer; "
        "needs `distributed`; false: by depth alone, as in episodes recorded before this option "
        "was there",
    )
    dents: bool = Field(
        default=True,
        description="images show struck objects deformed, by the material point method",
    )
    breakage: bool = Field(
        default=True,
        description="sheet of struck vehicles folds, their lamps and glass break, and fragments "
        "stay on the road; false: dents only, as in episodes recorded before this option was there",
    )


class ScoringSpec(Model):
    """Inputs of the scores in addition to the log."""

    speed_limit: Speed | None = Field(default=None, description="[m/s]; None: no limit is known")
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
    def _goes_on_beyond_the_log(cls, fields: Any) -> Any:
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
        description="of what `randomization` and `agents.spawn` draw; without them episodes of all "
        "seeds are the same",
    )
    randomization: Randomization = Randomization()
    start_us: Microseconds | None = Field(default=None, description="default: start of the log")
    dt_us: int = Field(default=100_000, ge=1_000, le=1_000_000, description="clock step")
    horizon: int | None = Field(
        default=None,
        ge=1,
        le=MAX_HORIZON,
        description="steps; default, and most where `beyond_log` is 'end': to the end of the log; "
        "default where the episode goes on: an hour, at most 1,000,000 steps",
    )
    beyond_log: Literal["end", "loop", "extend"] = Field(
        default="end",
        description="what a horizon beyond the recording leads to: 'end' refuses it; 'loop' puts "
        "the ego back to the start of the recorded drive whenever it has reached its end, with an "
        "event `looped`; 'extend' lets the route go on, its last bend fading into a straight line",
    )
    warmup_us: int = Field(
        default=0, ge=0, description="the ego moves as recorded for so long; plans wait"
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
        description="what entities do, and when; they are moved by it and by no driver of "
        "`agents`. Default: that of the scenario; one without entities runs none",
    )
    privileged: bool = Field(
        default=False,
        description="fill `agents` of every observation, and `lanes` where the scene has a map",
    )
    deadline_ms: int | None = Field(
        default=None, ge=1, le=3_600_000, description="wall-clock time for a plan; None: any"
    )
    on_timeout: Literal["hold_plan", "brake", "pause", "fail"] = Field(
        default="hold_plan", description="what happens when a plan misses its deadline"
    )
    wall_clock_s: Annotated[float, Field(gt=0, le=86_400)] | None = Field(
        default=None, description="wall-clock time after which the episode is cut off [s]"
    )
    latency: LatencySpec = LatencySpec()
    on_collision: Literal["terminate", "continue"] = Field(
        default="terminate", description="'continue' exchanges momentum and goes on"
    )
    contact: ContactSpec = ContactSpec()
    scoring: ScoringSpec = ScoringSpec()
