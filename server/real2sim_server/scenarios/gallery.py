"""The gallery of corner cases: storyboards with parameters, for any scene with a road ahead.

All cases are relative to the ego's start and lane, so they fit every scene; speeds are in m/s.
Families and values follow Euro NCAP's test protocols of 2023 (AEB car-to-car, AEB/LSS vulnerable
road user, lane support), rounded.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from real2sim_proto.cases import (
    Actor,
    actor,
    at_time,
    beside,
    case,
    change_lane,
    completed,
    driven,
    ego,
    event,
    follow,
    from_entity,
    gap_below,
    in_lane,
    shift,
    speed_to,
    ttc_below,
)
from real2sim_proto.storyboard import Event, Storyboard
from real2sim_proto.storyboard_actions import (
    ControlPoint,
    FollowTrajectoryAction,
    Nurbs,
    SpeedPoint,
    SpeedProfileAction,
    SynchronizeAction,
)
from real2sim_proto.storyboard_conditions import Condition, Distance, StandStill

Actors = tuple[Actor, ...]
PICTURES = Path(__file__).parent / "pictures"


@dataclass(frozen=True)
class CornerCase:
    """A case of the gallery.

    Attributes:
        name: unique name.
        title: description in one sentence.
        family: one of ``FAMILIES``.
        parameters: their defaults; lengths in m, speeds in m/s, times in s.
        make: the actors, with numbers as expressions of the parameters.
    """

    name: str
    title: str
    family: str
    parameters: Mapping[str, float]
    make: Callable[[], Actors]

    def storyboard(self, **parameters: float) -> Storyboard:
        """The storyboard with other values for some parameters.

        Raises:
            ValueError: the case has no parameter of that name.
        """
        if unknown := sorted(set(parameters) - set(self.parameters)):
            raise ValueError(
                f"corner case {self.name!r} has no parameter {unknown[0]!r}; it has: "
                f"{', '.join(self.parameters)}"
            )
        values = {**self.parameters, **{k: float(v) for k, v in parameters.items()}}
        return case(*self.make(), name=self.title, author="Real2Sim", parameters=values)


GALLERY: dict[str, CornerCase] = {}
"""Cases by name."""

FAMILIES = {
    "ahead": "keeping a distance and braking for what is ahead",
    "lanes": "lane changes of others, and keeping the lane",
    "oncoming": "traffic that comes towards the ego",
    "crossing": "road users that cross the ego's path",
}
"""What the cases of each family test."""


def corner_case(name: str) -> CornerCase:
    """The case with a name, with or without the prefix ``gallery:``.

    Raises:
        ValueError: the gallery has no such case.
    """
    found = GALLERY.get(name.removeprefix("gallery:"))
    if found is None:
        raise ValueError(f"the gallery has no {name!r}; it has: {', '.join(GALLERY)}")
    return found


def shipped_picture(name: str) -> bytes:
    """The picture of a case, an SVG document made by `scenarios.picture`.

    Raises:
        ValueError: the gallery has no such case.
    """
    return (PICTURES / f"{corner_case(name).name}.svg").read_bytes()


def entry(
    family: str, title: str, **parameters: float
) -> Callable[[Callable[[], Actors]], Callable[[], Actors]]:
    """Add a function that makes the actors of a case to the gallery, under the function's name."""

    def register(make: Callable[[], Actors]) -> Callable[[], Actors]:
        name = make.__name__
        GALLERY[name] = CornerCase(name, title, family, parameters, make)
        return make

    return register


EGO_WIDTH = 1.85
"""Width of the ego, for impact positions as a share of it [m]."""

# The corner cases of the gallery.


@entry("ahead", "CCRs: a stationary car in the ego's lane", gap=40.0, offset=0.0)
def ccrs() -> Actors:
    """Euro NCAP CCRs."""
    return (actor("target", in_lane("$gap", left="$offset")),)


@entry(
    "ahead", "CCRm: a slower car drives ahead in the ego's lane", gap=30.0, speed=5.6, offset=0.0
)
def ccrm() -> Actors:
    """Euro NCAP CCRm."""
    return (actor("target", in_lane("$gap", left="$offset"), "$speed"),)


@entry("ahead", "CCRb: the car ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=6.0)
def ccrb() -> Actors:
    """Euro NCAP CCRb."""
    brake = event("brake", at_time("$delay"), speed_to(0.0, rate="$braking"))
    return (actor("target", in_lane("${$gap + 6}"), "$speed", brake),)


@entry("ahead", "CMRb: the motorcycle ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=4.0)
def cmrb() -> Actors:
    """Euro NCAP CMRb."""
    brake = event("brake", at_time("$delay"), speed_to(0.0, rate="$braking"))
    return (actor("rider", in_lane("${$gap + 6}"), "$speed", brake, body="motorcycle"),)


@entry(
    "ahead",
    "Hard brake: the car ahead brakes hard once the ego is near",
    gap=15.0,
    speed=7.0,
    braking=8.0,
)
def hard_brake() -> Actors:
    """Triggered by the gap, not by time."""
    brake = event("brake", gap_below("target", "$gap"), speed_to(0.0, rate="$braking"))
    return (actor("target", in_lane(30.0), "$speed", brake),)


@entry("ahead", "Stop and go: the lead vehicle slows to a crawl and accelerates again",
    gap=15.0, speed=8.0, slow=1.0, seconds=3.0,
)  # fmt: skip
def stop_and_go() -> Actors:
    """A queue with linearly changing speeds."""
    points = [
        SpeedPoint(time="$seconds", speed="$slow"),
        SpeedPoint(time=2.0, speed="$slow"),
        SpeedPoint(time="$seconds", speed="$speed"),
    ]
    slow_down = event("slow_down", at_time(1.0), SpeedProfileAction(points=points))
    return (actor("target", in_lane("${$gap + 6}"), "$speed", slow_down),)


@entry("ahead", "Debris in the ego's lane", gap=45.0, offset=0.3)
def debris() -> Actors:
    """Too high to drive over."""
    return (actor("debris", in_lane("$gap", left="$offset"), body="debris"),)


@entry("ahead", "CBLA: a cyclist rides ahead in the ego's lane", gap=30.0, speed=4.2, offset=-0.4)
def cbla() -> Actors:
    """Euro NCAP CBLA."""
    return (actor("cyclist", in_lane("$gap", left="$offset"), "$speed", body="cyclist"),)


@entry("ahead", "CPLA: an adult walks ahead in the ego's lane", gap=35.0, speed=1.39, offset=-0.8)
def cpla() -> Actors:
    """Euro NCAP CPLA."""
    return (actor("adult", in_lane("$gap", left="$offset"), "$speed", body="adult"),)


# --- Lanes ---------------------------------------------------------------------------------------


@entry(
    "lanes", "Cut-in: a car moves in from the left, close ahead", gap=12.0, speed=7.0, duration=2.0
)
def cut_in() -> Actors:
    """Slower than the ego, so that its gap shrinks."""
    move = event("move_in", gap_below("cutter", "$gap"), change_lane(0, seconds="$duration"))
    return (actor("cutter", in_lane(35.0, lane=1, heading=0.0), "$speed", move),)


@entry("lanes", "Cut-in and brake: a car moves in close ahead, and brakes there",
    gap=10.0, speed=8.0, duration=1.5, braking=6.0,
)  # fmt: skip
def cut_in_brake() -> Actors:
    """Brakes as soon as it is in the ego's lane."""
    move = event("move_in", gap_below("cutter", "$gap"), change_lane(0, seconds="$duration"))
    brake = event("brake", completed("move_in"), speed_to(0.0, rate="$braking"))
    return (actor("cutter", in_lane(25.0, lane=1, heading=0.0), "$speed", move, brake),)


@entry(
    "lanes",
    "Cut-out: the lead vehicle leaves the lane before a stationary car",
    gap=14.0,
    speed=9.0,
    reveal=25.0,
)
def cut_out() -> Actors:
    """A van hides a stationary object until it leaves the lane."""
    far = gap_below("standing", "$reveal", of="leader")
    out = event("move_out", far, change_lane(1, of="leader", seconds=2.0))
    leader = actor("leader", in_lane("${$gap + 6}"), "$speed", out, body="van")
    return leader, actor("standing", in_lane(80.0))


@entry("lanes", "Pull out: a parked car pulls out before the ego",
    ahead=45.0, time=2.0, acceleration=2.5, speed=6.0, length=10.0,
)  # fmt: skip
def pull_out() -> Actors:
    """Pulls out from the roadside; its lateral motion depends on the driven distance."""
    out = event(
        "pull_out", ttc_below("parked", "$time"), speed_to("$speed", rate="$acceleration"),
        change_lane(0, metres="$length"),
    )  # fmt: skip
    return (actor("parked", beside("$ahead", -2.8), 0.0, out),)


@entry("lanes", "LSS overtaking: a faster car overtakes and comes back close ahead",
    behind=20.0, speed=15.0, duration=2.5,
)  # fmt: skip
def lss_overtaking() -> Actors:
    """Euro NCAP's overtaking vehicle, but with an early return."""
    past = Distance(
        entities=["overtaker"], position=from_entity("Ego", 9.0, 3.5), rule="less_or_equal",
        value=2.5,
    )  # fmt: skip
    back = event("come_back", past, change_lane(0, seconds="$duration"))
    start = in_lane("${-1 * $behind}", lane=1, heading=0.0)
    return (actor("overtaker", start, "$speed", back),)


@entry("lanes", "LSS lane keeping: the ego begins headed over the line", offset=0.5, heading=0.05)
def lss_keep() -> Actors:
    """Euro NCAP's lateral drift of 0.2 to 0.6 m/s: 0.02 to 0.06 rad at 10 m/s."""
    return (ego(in_lane(0.0, left="$offset", heading="$heading")),)


# --- Oncoming ------------------------------------------------------------------------------------


@entry("oncoming", "Wrong way: a car comes towards the ego in its lane", ahead=90.0, speed=8.0)
def wrong_way() -> Actors:
    """Drives against the traffic in the middle of the lane."""
    return (actor("ghost", in_lane("$ahead", heading=math.pi), "$speed"),)


@entry(
    "oncoming",
    "CCFhos: a car comes towards the ego, half in its lane",
    ahead=120.0,
    speed=13.9,
    offset=0.9,
)
def ccfhos() -> Actors:
    """Euro NCAP CCFhos: head-on, straight, 50 % overlap."""
    return (actor("target", in_lane("$ahead", left="$offset", heading=math.pi), "$speed"),)


@entry("oncoming", "CCFhol: an oncoming car overtakes and comes into the ego's lane",
    ahead=120.0, speed=11.0, slow=6.0, distance=80.0, duration=2.0,
)  # fmt: skip
def ccfhol() -> Actors:
    """Euro NCAP CCFhol: head-on, lane change; here the other car changes lanes."""
    there = in_lane("${$ahead - 30}", lane=1, heading=math.pi)
    behind = in_lane("$ahead", lane=1, heading=math.pi)
    near = gap_below("overtaker", "$distance")
    out = event("move_out", near, change_lane(0, seconds="$duration"))
    return actor("overtaken", there, "$slow", body="van"), actor("overtaker", behind, "$speed", out)


@entry("oncoming", "LSS oncoming: an oncoming car drifts over into the ego's lane",
    ahead=90.0, speed=8.0, distance=45.0, drift=2.0,
)  # fmt: skip
def lss_oncoming() -> Actors:
    """Euro NCAP's oncoming vehicle, but drifting."""
    drift = event("drift", gap_below("oncoming", "$distance"), shift("$drift", acceleration=0.8))
    return (actor("oncoming", in_lane("$ahead", lane=1, heading=math.pi), "$speed", drift),)


@entry("oncoming", "CCFtap: an oncoming car that waits turns left across the ego's path",
    ahead=50.0, time=2.2, radius=7.0, acceleration=3.0, speed=7.0,
)  # fmt: skip
def ccftap() -> Actors:
    """Euro NCAP CCFtap: front turn across path; here the other car turns.

    By default it is in the middle of the ego's lane when the ego arrives.
    """
    points = [
        ControlPoint(position=from_entity("turner", 0.0)),
        ControlPoint(position=from_entity("turner", "$radius"), weight=0.7071067811865476),
        ControlPoint(position=from_entity("turner", "$radius", "$radius")),
    ]
    quarter = Nurbs(order=3, knots=[0.0, 0.0, 0.0, 1.0, 1.0, 1.0], points=points)
    turn = event(
        "turn", ttc_below("turner", "$time"),
        FollowTrajectoryAction(name="left_turn", curve=quarter),
        speed_to("$speed", rate="$acceleration"),
    )  # fmt: skip
    start = in_lane("${$ahead + $radius}", lane=1, heading=math.pi)
    return (actor("turner", start, 0.0, turn),)


# --- Crossing ------------------------------------------------------------------------------------

# A crossing actor starts when the ego reaches the distance at which both meet. The actor is then at
# a share of the ego's width, measured from the side that it comes from.

NEAR, FAR = -1.0, 1.0
"""Side that the actor comes from: right or left."""


@entry(
    "crossing",
    "CPNA: an adult crosses from the near side",
    ahead=45.0,
    distance=4.0,
    speed=1.39,
    impact=0.5,
)
def cpna() -> Actors:
    """Euro NCAP CPNA-50."""
    return _crossing("adult", NEAR)


@entry("crossing", "CPNA-25: an adult from the near side, hit at a quarter of the ego's width",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.25,
)  # fmt: skip
def cpna_25() -> Actors:
    """Euro NCAP CPNA-25."""
    return _crossing("adult", NEAR)


@entry("crossing", "CPNA-75: an adult from the near side, hit at three quarters of the ego's width",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.75,
)  # fmt: skip
def cpna_75() -> Actors:
    """Euro NCAP CPNA-75."""
    return _crossing("adult", NEAR)


@entry(
    "crossing",
    "CPFA: an adult runs across from the far side",
    ahead=45.0,
    distance=6.0,
    speed=2.22,
    impact=0.5,
)
def cpfa() -> Actors:
    """Euro NCAP CPFA-50."""
    return _crossing("adult", FAR)


@entry("crossing", "Occluded pedestrian (CPNCO): a child comes out between parked cars",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.5,
)  # fmt: skip
def occluded_pedestrian() -> Actors:
    """Euro NCAP CPNCO-50."""
    return _crossing("child", NEAR, hidden=True)


@entry("crossing", "Hesitating pedestrian: an adult stops in the ego's lane, then continues",
    ahead=45.0, distance=4.0, speed=1.39, impact=0.5, stop=3.2, pause=1.5,
)  # fmt: skip
def hesitating_pedestrian() -> Actors:
    """Stops after a distance, for a duration."""
    walked = driven("crosser", "$stop")
    stood = StandStill(entities=["crosser"], duration="$pause")
    walking = [Condition(name="stood", test=stood), Condition(name="walked", test=walked)]
    return _crossing(
        "adult", NEAR,
        event("stop", walked, speed_to(0.0, rate=4.0)),
        event("go_on", walking, speed_to("$speed", rate=4.0)),
    )  # fmt: skip


@entry(
    "crossing",
    "CBNA: a cyclist crosses from the near side",
    ahead=50.0,
    distance=17.0,
    speed=4.17,
    impact=0.5,
)
def cbna() -> Actors:
    """Euro NCAP CBNA-50."""
    return _crossing("cyclist", NEAR)


@entry(
    "crossing",
    "CBFA: a cyclist crosses from the far side",
    ahead=50.0,
    distance=17.0,
    speed=4.17,
    impact=0.5,
)
def cbfa() -> Actors:
    """Euro NCAP CBFA-50."""
    return _crossing("cyclist", FAR)


@entry(
    "crossing",
    "Animal: a deer runs across from the near side",
    ahead=50.0,
    distance=9.0,
    speed=6.0,
    impact=0.5,
)
def animal() -> Actors:
    """Speed of a trotting roe deer."""
    return _crossing("deer", NEAR)


@entry("crossing", "Junction crossing (CCCscp): a car crosses so that both arrive together",
    ahead=45.0, distance=35.0, speed=8.0,
)  # fmt: skip
def junction_crossing() -> Actors:
    """Constant motion independent of the ego, until they meet."""
    start = beside("$ahead", "${-1 * $distance}", math.pi / 2)
    meet = SynchronizeAction(
        master="Ego",
        master_target=beside("$ahead", 0.0),
        target=beside("$ahead", 0.0),
        final_speed="$speed",
    )
    return (actor("crosser", start, "$speed", event("meet", at_time(0.0), meet)),)


def _crossing(body: str, side: float, *more: Event, hidden: bool = False) -> Actors:
    start = beside("$ahead", f"${{{side} * $distance}}", -side * math.pi / 2)
    ends = from_entity("crosser", 0.0), from_entity("crosser", "${2 * $distance}")
    way = f"($distance + ($impact - 0.5) * {EGO_WIDTH})"
    cross = event(
        "cross", ttc_below("crosser", f"${{{way} / $speed}}"), follow(*ends, name="crossing"),
        speed_to("$speed"),
    )  # fmt: skip
    crosser = actor("crosser", start, 0.0, cross, *more, body=body)
    if not hidden:
        return (crosser,)
    parked = [("parked_1", -9.0), ("parked_2", -2.6 - 1.35 - 2.25)]
    return crosser, *(
        actor(name, beside(f"${{$ahead + {behind}}}", side * 3.0)) for name, behind in parked
    )
