"""What happens in each corner case of the gallery in closed form, before an ego at 10 m/s.

Written from the cases' titles and parameters, with nothing of what runs them: where everybody is
and how fast, from where the ego's rear axle began, along and to the left of its road.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

EGO_SPEED = 10.0
LANE = 3.5
EGO_FRONT, CAR_FRONT, VAN_FRONT, CAR_REAR = 3.65, 3.6, 4.3, 0.9
"""From a rear axle to the ends of its car [m]."""

Course = Callable[[float], tuple[float, float, float]]
"""x, y [m] and speed [m/s] at a time [s]."""


class Definition(NamedTuple):
    """When its events begin [s], and the course of everybody."""

    starts: dict[str, float]
    courses: dict[str, Course]


# --- motion -----------------------------------------------------------------------------------


def ramp(t: float, before: float, after: float, rate: float) -> tuple[float, float]:
    """Way and speed since a change of speed by a constant acceleration began."""
    duration = abs(after - before) / rate
    if t <= 0.0:
        return before * t, before
    if t >= duration:
        return (before + after) / 2 * duration + after * (t - duration), after
    a = math.copysign(rate, after - before)
    return before * t + a * t * t / 2, before + a * t


def form(t: float, start: float, duration: float) -> float:
    """Share of a sinusoidal change."""
    u = min(max((t - start) / duration, 0.0), 1.0)
    return (1.0 - math.cos(math.pi * u)) / 2


def along(t: float, start: float, duration: float, speed: float, width: float) -> float:
    """Way along the road at a constant speed, of which a part is across it in between."""
    u = (np.arange(1000) + 0.5) / 1000 * min(max((t - start) / duration, 0.0), 1.0)
    across = width / 2 * math.pi / duration * np.sin(math.pi * u)
    changing = min(max(t - start, 0.0), duration)
    return speed * (t - changing) + float(np.sqrt(speed**2 - across**2).mean()) * changing


def steady(x: float, y: float, speed: float, sense: float = 1.0) -> Course:
    return lambda t: (x + sense * speed * t, y, speed)


def changing_lane(
    x: float, start: float, duration: float, speed: float, before: float, after: float,
    sense: float = 1.0,
) -> Course:  # fmt: skip
    def course(t: float) -> tuple[float, float, float]:
        way = along(t, start, duration, speed, after - before)
        return x + sense * way, before + (after - before) * form(t, start, duration), speed

    return course


# --- ahead ------------------------------------------------------------------------------------


def standing(gap: float, offset: float) -> Definition:
    return Definition({}, {"": steady(gap, offset, 0.0)})


def slower(gap: float, speed: float, offset: float) -> Definition:
    return Definition({}, {"": steady(gap, offset, speed)})


def braking_at(start: float, x: float, speed: float, braking: float) -> Definition:
    def course(t: float) -> tuple[float, float, float]:
        way, v = ramp(t - start, speed, 0.0, braking)
        return x + speed * start + way, 0.0, v

    return Definition({"brake": start}, {"": course})


def ccrb(gap: float, speed: float, delay: float, braking: float) -> Definition:
    return braking_at(delay, gap + 6.0, speed, braking)


def hard_brake(gap: float, speed: float, braking: float) -> Definition:
    start = (30.0 - EGO_FRONT - CAR_REAR - gap) / (EGO_SPEED - speed)
    return braking_at(start, 30.0, speed, braking)


def stop_and_go(gap: float, speed: float, slow: float, seconds: float) -> Definition:
    rate = (speed - slow) / seconds

    def course(t: float) -> tuple[float, float, float]:
        down, v = ramp(t - 1.0, speed, slow, rate)
        up, w = ramp(t - 3.0 - seconds, 0.0, speed - slow, rate)
        return gap + 6.0 + speed + down + up, 0.0, v + w

    return Definition({"slow_down": 1.0}, {"": course})


# --- lanes ------------------------------------------------------------------------------------


def cut_in(gap: float, speed: float, duration: float) -> Definition:
    start = (35.0 - EGO_FRONT - CAR_REAR - gap) / (EGO_SPEED - speed)
    return Definition(
        {"move_in": start},
        {"": changing_lane(35.0, start, duration, speed, LANE, 0.0)},
    )


def cut_in_brake(gap: float, speed: float, duration: float, braking: float) -> Definition:
    start = (25.0 - EGO_FRONT - CAR_REAR - gap) / (EGO_SPEED - speed)
    done = start + duration

    def course(t: float) -> tuple[float, float, float]:
        way, v = ramp(max(t - done, 0.0), speed, 0.0, braking)
        way += along(min(t, done), start, duration, speed, LANE)
        return 25.0 + way, LANE * (1 - form(t, start, duration)), v

    return Definition({"move_in": start, "brake": done}, {"": course})


def cut_out(gap: float, speed: float, reveal: float) -> Definition:
    start = (80.0 - CAR_REAR - (gap + 6.0) - VAN_FRONT - reveal) / speed
    leader = changing_lane(gap + 6.0, start, 2.0, speed, 0.0, LANE)
    return Definition({"move_out": start}, {"leader": leader, "standing": steady(80.0, 0.0, 0.0)})


def pull_out(
    ahead: float, time: float, acceleration: float, speed: float, length: float
) -> Definition:
    start = (ahead - CAR_REAR - EGO_FRONT) / EGO_SPEED - time

    def course(t: float) -> tuple[float, float, float]:
        way, v = ramp(t - start, 0.0, speed, acceleration)
        x = ahead + along(way, 0.0, length, 1.0, 2.8)
        return x, -2.8 * (1 - form(way, 0.0, length)), v

    return Definition({"pull_out": start}, {"": course})


def lss_overtaking(behind: float, speed: float, duration: float) -> Definition:
    start = (9.0 + behind - 2.5) / (speed - EGO_SPEED)
    return Definition(
        {"come_back": start},
        {"": changing_lane(-behind, start, duration, speed, LANE, 0.0)},
    )


def lss_keep(offset: float, heading: float) -> Definition:
    return Definition({}, {})


# --- oncoming ---------------------------------------------------------------------------------


def wrong_way(ahead: float, speed: float) -> Definition:
    return Definition({}, {"": steady(ahead, 0.0, speed, -1.0)})


def ccfhos(ahead: float, speed: float, offset: float) -> Definition:
    return Definition({}, {"": steady(ahead, offset, speed, -1.0)})


def ccfhol(ahead: float, speed: float, slow: float, distance: float, duration: float) -> Definition:
    start = (ahead - CAR_FRONT - EGO_FRONT - distance) / (EGO_SPEED + speed)
    return Definition(
        {"move_out": start},
        {
            "overtaken": steady(ahead - 30.0, LANE, slow, -1.0),
            "overtaker": changing_lane(ahead, start, duration, speed, LANE, 0.0, -1.0),
        },
    )


def lss_oncoming(ahead: float, speed: float, distance: float, drift: float) -> Definition:
    start = (ahead - CAR_FRONT - EGO_FRONT - distance) / (EGO_SPEED + speed)
    # A sinusoidal change by d has (pi / T)^2 d / 2 as its highest acceleration.
    duration = math.pi * math.sqrt(drift / (2 * 0.8))

    def course(t: float) -> tuple[float, float, float]:
        # A lane offset leaves the speed along the lane.
        return ahead - speed * t, LANE - drift * form(t, start, duration), speed

    return Definition({"drift": start}, {"": course})


def ccftap(
    ahead: float, time: float, radius: float, acceleration: float, speed: float
) -> Definition:
    start = (ahead + radius - CAR_FRONT - EGO_FRONT) / EGO_SPEED - time

    def course(t: float) -> tuple[float, float, float]:
        way, v = ramp(t - start, 0.0, speed, acceleration)
        angle, beyond = min(way / radius, math.pi / 2), max(way - radius * math.pi / 2, 0.0)
        return (
            ahead + radius - radius * math.sin(angle),
            LANE - radius * (1 - math.cos(angle)) - beyond,
            v,
        )

    return Definition({"turn": start}, {"": course})


# --- crossing ---------------------------------------------------------------------------------


def crossing(
    ahead: float, distance: float, speed: float, impact: float, *, side: float, half: float
) -> Definition:
    """``half``: of the width of who crosses, which the ego's front comes to first."""
    way = distance + (impact - 0.5) * 1.85
    start = (ahead - half - EGO_FRONT) / EGO_SPEED - way / speed

    def course(t: float) -> tuple[float, float, float]:
        walked = speed * max(t - start, 0.0)
        return ahead, side * (distance - walked), speed if t >= start else 0.0

    return Definition({"cross": start}, {"crosser": course})


def hidden(**parameters: float) -> Definition:
    found = crossing(**parameters, side=-1.0, half=0.25)
    for name, behind in (("parked_1", 9.0), ("parked_2", 6.2)):
        found.courses[name] = steady(parameters["ahead"] - behind, -3.0, 0.0)
    return found


def hesitating(stop: float, pause: float, **parameters: float) -> Definition:
    speed, rate = parameters["speed"], 4.0
    free = crossing(**parameters, side=-1.0, half=0.3)
    at = free.starts["cross"] + stop / speed
    on = at + speed / rate + pause

    def course(t: float) -> tuple[float, float, float]:
        if t < at:
            return free.courses["crosser"](t)
        walked, v = ramp(t - at, speed, 0.0, rate)
        more, w = ramp(max(t - on, 0.0), 0.0, speed, rate)
        return parameters["ahead"], -parameters["distance"] + stop + walked + more, v + w

    return Definition({**free.starts, "stop": at, "go_on": on}, {"crosser": course})


def junction(ahead: float, distance: float, speed: float) -> Definition:
    """One acceleration up to half of the time, and its opposite then."""
    arrival = ahead / EGO_SPEED
    excess = distance - speed * arrival

    def course(t: float) -> tuple[float, float, float]:
        u = min(t / arrival, 1.0)
        share, slope = (2 * u**2, 4 * u) if u < 0.5 else (1 - 2 * (1 - u) ** 2, 4 * (1 - u))
        way = speed * t + excess * share
        return ahead, way - distance, speed + excess * slope / arrival

    return Definition({"meet": 0.0}, {"crosser": course})


def walks(side: float, half: float) -> Callable[..., Definition]:
    return lambda **parameters: crossing(**parameters, side=side, half=half)


DEFINITIONS: dict[str, Callable[..., Definition]] = {
    "ccrs": standing, "ccrm": slower, "ccrb": ccrb, "cmrb": ccrb, "hard_brake": hard_brake,
    "stop_and_go": stop_and_go, "debris": standing, "cbla": slower, "cpla": slower,
    "cut_in": cut_in, "cut_in_brake": cut_in_brake, "cut_out": cut_out, "pull_out": pull_out,
    "lss_overtaking": lss_overtaking, "lss_keep": lss_keep, "wrong_way": wrong_way,
    "ccfhos": ccfhos, "ccfhol": ccfhol, "lss_oncoming": lss_oncoming, "ccftap": ccftap,
    "cpna": walks(-1.0, 0.3), "cpna_25": walks(-1.0, 0.3), "cpna_75": walks(-1.0, 0.3),
    "cpfa": walks(1.0, 0.3), "occluded_pedestrian": hidden, "hesitating_pedestrian": hesitating,
    "cbna": walks(-1.0, 0.3), "cbfa": walks(1.0, 0.3), "animal": walks(-1.0, 0.25),
    "junction_crossing": junction,
}  # fmt: skip
"""By name of the case; "" is the only one who takes part."""
