"""Somebody ahead in the ego's lane stands, is slow, or brakes."""

from __future__ import annotations

from .case import Fields, case
from .parts import (
    ADULT,
    CAR,
    CYCLIST,
    DEBRIS,
    MOTORCYCLE,
    after,
    ahead,
    board,
    event,
    near,
    put,
    speed_to,
)


@case("CCRs: a car stands in the ego's lane", gap=40.0, offset=0.0)
def ccrs() -> Fields:
    """Euro NCAP CCRs."""
    return board([("target", "car", CAR)], put("target", ahead("$gap", offset="$offset")))


@case("CCRm: a slower car drives ahead in the ego's lane", gap=30.0, speed=5.6, offset=0.0)
def ccrm() -> Fields:
    """Euro NCAP CCRm."""
    init = put("target", ahead("$gap", offset="$offset"), "$speed")
    return board([("target", "car", CAR)], init)


@case("CCRb: the car ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=6.0)
def ccrb() -> Fields:
    """Euro NCAP CCRb."""
    init = put("target", ahead("${$gap + 6}"), "$speed")
    brake = event("brake", after("$delay"), speed_to(0.0, "$braking"))
    return board([("target", "car", CAR)], init, target=[brake])


@case("CMRb: the motorcycle ahead brakes", gap=20.0, speed=10.0, delay=2.0, braking=4.0)
def cmrb() -> Fields:
    """Euro NCAP CMRb."""
    init = put("rider", ahead("${$gap + 6}"), "$speed")
    brake = event("brake", after("$delay"), speed_to(0.0, "$braking"))
    return board([("rider", "motorcycle", MOTORCYCLE)], init, rider=[brake])


@case(
    "Hard brake: the car ahead brakes hard once the ego is near", gap=15.0, speed=7.0, braking=8.0
)
def hard_brake() -> Fields:
    """At the gap, not at a time."""
    init = put("target", ahead(30.0), "$speed")
    brake = event("brake", near("target", "$gap"), speed_to(0.0, "$braking"))
    return board([("target", "car", CAR)], init, target=[brake])


@case(
    "Stop and go: the car ahead slows down to a crawl and goes on",
    gap=15.0, speed=8.0, slow=1.0, seconds=3.0,
)  # fmt: skip
def stop_and_go() -> Fields:
    """A queue in which speeds change linearly."""
    init = put("target", ahead("${$gap + 6}"), "$speed")
    points = [("$seconds", "$slow"), (2.0, "$slow"), ("$seconds", "$speed")]
    profile = {
        "kind": "speed_profile",
        "points": [{"time": time, "speed": speed} for time, speed in points],
    }
    return board([("target", "car", CAR)], init, target=[event("slow_down", after(1.0), profile)])


@case("Debris lies in the ego's lane", gap=45.0, offset=0.3)
def debris() -> Fields:
    """Too high to drive over."""
    return board([("debris", "obstacle", DEBRIS)], put("debris", ahead("$gap", offset="$offset")))


@case("CBLA: a cyclist rides ahead in the ego's lane", gap=30.0, speed=4.2, offset=-0.4)
def cbla() -> Fields:
    """Euro NCAP CBLA."""
    init = put("cyclist", ahead("$gap", offset="$offset"), "$speed")
    return board([("cyclist", "cyclist", CYCLIST)], init)


@case("CPLA: an adult walks ahead in the ego's lane", gap=35.0, speed=1.39, offset=-0.8)
def cpla() -> Fields:
    """Euro NCAP CPLA."""
    init = put("adult", ahead("$gap", offset="$offset"), "$speed")
    return board([("adult", "pedestrian", ADULT)], init)
