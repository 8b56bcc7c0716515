"""Random draws of an episode by its seed."""

from __future__ import annotations

import numpy as np
import pytest

from real2sim_proto.episode import ResetSpec
from real2sim_proto.plans import Control
from real2sim_server.edit import ScenarioState
from real2sim_server.world import World, WorldError
from real2sim_server.world.common import Draws
from real2sim_server.world.recording import (
    digest,
    first_difference,
    record,
    recording_of_bytes,
    to_bytes,
)
from real2sim_server.world.replay import Entry, Replayer, action_payload, reset_payload

COAST = Control(acceleration=0.0, steering=0.0)
CONTROL = {"action": "control", "privileged": True}
START = {"start": {"longitudinal": 2.0, "lateral": 0.5, "heading": 0.05, "speed": 3.0}}
NOISE = {"estimate": {"position": 0.5, "heading": 0.02, "speed": 0.3}}


@pytest.fixture
def begun(make_world, moving):
    """Make a world with a seed and a ``randomization``."""

    def make(seed: int, randomization: dict, *, spec: dict | None = None, **cars):
        fields = CONTROL | {"seed": seed, "randomization": randomization} | (spec or {})
        return make_world(spec=fields, **cars)

    return make


def driven(world: World, steps: int = 20) -> list[str]:
    found = [digest(world)]
    for _ in range(steps):
        world.step(COAST)
        found.append(digest(world))
    return found


# --- draws ----------------------------------------------------------------------------------------


def test_a_draw_depends_only_on_seed_name_and_counters():
    draws = Draws(7)
    first = draws.uniform("start", 3)
    draws.uniform("other", 4)
    assert Draws(7).uniform("start", 3) == first
    others = [Draws(8).uniform("start", 3), draws.uniform("start", 4), draws.uniform("begin", 3)]
    assert all(other != first for other in others)


def test_draws_are_stable_across_versions():
    # Recordings and sessions of earlier versions depend on these numbers.
    assert Draws(1).uniform("start.lateral", 0) == [0.9954353250238952]


def test_normal_draws_have_mean_0_and_deviation_1():
    numbers = [n for k in range(2000) for n in Draws(0).normal("estimate", k, count=4)]
    assert np.mean(numbers) == pytest.approx(0.0, abs=0.05)
    assert np.std(numbers) == pytest.approx(1.0, abs=0.03)


# --- the default ----------------------------------------------------------------------------------


def test_seeds_have_no_effect_without_randomization(begun):
    assert driven(begun(0, {})) == driven(begun(12345, {}))


def test_observations_without_randomization_have_no_extra_fields(begun):
    fields = begun(3, {}).observe().obs_fields()
    assert not {"drawn", "ego_truth", "lap"} & set(fields)


# --- start ----------------------------------------------------------------------------------------


def test_a_random_start_is_within_its_ranges_and_reported(begun):
    for seed in range(20):
        world = begun(seed, START)
        motion, drawn = world.motion, world.observe().drawn
        assert motion.x == pytest.approx(drawn["start.longitudinal"], abs=1e-9)
        assert motion.y == pytest.approx(drawn["start.lateral"], abs=1e-9)
        assert motion.yaw == pytest.approx(drawn["start.heading"], abs=1e-9)
        assert motion.speed == pytest.approx(10.0 + drawn["start.speed"], abs=1e-9)
        assert abs(motion.x) <= 2.0
        assert abs(motion.y) <= 0.5
        assert abs(motion.yaw) <= 0.05


def test_episodes_depend_only_on_the_seed(begun):
    assert driven(begun(1, START)) == driven(begun(1, START))
    assert driven(begun(1, START)) != driven(begun(2, START))


def test_a_drawn_start_never_overlaps_another_car(begun, moving):
    # A third of all possible starts would touch the car ahead.
    car = moving(7.0, 0, z=0.8)
    ranges = {"start": {"longitudinal": 3.0}}
    for seed in range(20):
        world = begun(seed, ranges, car=car)
        world.step(Control(acceleration=-8.0, steering=0.0))
        assert world.observe().drawn == {}
        assert not world._contacts.ignored_pairs


def test_drawn_values_are_only_in_the_first_observation(begun):
    world = begun(1, START)
    assert set(world.observe().drawn) == {f"start.{name}" for name in START["start"]}
    world.step(COAST)
    assert world.observe().drawn == {}
    assert set(world.sampled) == {f"start.{name}" for name in START["start"]}


def test_a_random_start_with_a_warm_up_is_refused(begun):
    with pytest.raises(WorldError, match="moves the start off it"):
        begun(1, START, spec={"warmup_us": 500_000})


# --- traffic --------------------------------------------------------------------------------------


def test_parameters_of_idm_are_drawn_for_each_object(begun, moving):
    cars = {"a": moving(30, 0, z=0.8, speed=6.0), "b": moving(60, 0, z=0.8, speed=6.0)}
    spec = {"agents": {"default": "idm"}}
    drawn = begun(4, {"traffic": {"headway": 0.3, "desired_speed": 0.2}}, spec=spec, **cars).sampled
    assert set(drawn) == {f"agents.{c}.{n}" for c in "ab" for n in ("headway", "desired_speed")}
    assert 1.05 <= drawn["agents.a.headway"] <= 1.95
    assert 4.8 <= drawn["agents.a.desired_speed"] <= 7.2
    assert drawn["agents.a.headway"] != drawn["agents.b.headway"]


def test_draws_for_an_object_do_not_depend_on_others(begun, moving):
    a, b = moving(30, 0, z=0.8, speed=6.0), moving(60, 0, z=0.8, speed=6.0)
    spec, ranges = {"agents": {"default": "idm"}}, {"traffic": {"headway": 0.3}}
    alone = begun(4, ranges, spec=spec, b=b).sampled["agents.b.headway"]
    assert begun(4, ranges, spec=spec, a=a, b=b).sampled["agents.b.headway"] == alone


# --- ego estimate ---------------------------------------------------------------------------------


def test_the_estimate_has_errors_and_the_truth_is_privileged(begun):
    world = begun(1, NOISE)
    errors = []
    for _ in range(60):
        world.step(COAST)
        fields = world.observe().obs_fields()
        truth, estimate = fields["ego_truth"], fields["ego"]
        assert truth["position"] == pytest.approx(world.T_world_vehicle[:3, 3])
        errors.append(np.subtract(estimate["position"], truth["position"])[:2])
    assert np.std(errors) == pytest.approx(0.5, rel=0.25)


def test_the_truth_is_hidden_without_privilege(begun):
    fields = begun(1, NOISE, spec={"privileged": False}).observe().obs_fields()
    assert "ego_truth" not in fields
    assert fields["agents"] == []


def test_the_estimate_does_not_affect_the_motion(begun):
    exact, noisy = begun(1, {}), begun(1, NOISE)
    for _ in range(20):
        exact.step(COAST)
        noisy.step(COAST)
    assert noisy.motion == exact.motion
    assert noisy.metrics() == exact.metrics()


def test_the_route_is_relative_to_the_estimate(begun):
    world = begun(2, {"estimate": {"heading": 0.2}})
    estimate = world.observe()
    ahead = estimate.route[-1]
    assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(-estimate.motion.yaw, abs=1e-6)


def test_correlated_errors_change_slowly(begun):
    def steps_of(correlation: float) -> float:
        noise = {"position": 1.0, "correlation": correlation}
        world, found = begun(3, {"estimate": noise}), []
        for _ in range(50):
            world.step(COAST)
            found.append(world.observe().motion.y - world.motion.y)
        return float(np.abs(np.diff(found)).mean())

    assert steps_of(20.0) < 0.3 * steps_of(0.0)


# --- latency --------------------------------------------------------------------------------------


def test_latency_is_drawn_for_each_plan(begun):
    world, waits = begun(1, {"latency_us": 300_000}), []
    for _ in range(20):
        world.step(COAST)
        waits.append(world.observe().drawn["latency_us"])
    assert 0 <= min(waits) < 100_000
    assert 200_000 < max(waits) <= 300_000


def test_a_plan_takes_effect_after_the_drawn_latency(begun):
    at_once = {"actuators": {"drive_lag": 0.0, "steering_lag": 0.0}}
    world = begun(1, {"latency_us": 300_000}, spec={"ego": at_once})
    speeds, wait = [], None
    for _ in range(6):
        world.step(Control(acceleration=-2.0, steering=0.0) if wait is None else None)
        wait = world.observe().drawn.get("latency_us", wait) if wait is None else wait
        speeds.append(world.motion.speed)
    braked = 0.6 - wait * 1e-6
    assert speeds[-1] == pytest.approx(10.0 - 2.0 * braked, abs=0.02)


# --- forks, recordings ----------------------------------------------------------------------------

ALL = START | NOISE | {"traffic": {"headway": 0.3}, "latency_us": 50_000}
SPAWNING = {"agents": {"spawn": {"density": 60, "lanes": [{"offset": 3.5}]}}}


def test_a_fork_continues_with_the_same_draws(begun, moving):
    world = begun(9, ALL, spec=SPAWNING, car=moving(30, 0, z=0.8, speed=6.0))
    driven(world, 5)
    fork = world.fork()
    assert driven(world) == driven(fork)


def test_a_recording_holds_the_drawn_values_and_replays(make_scene, moving):
    scene = make_scene(car=moving(30, 0, z=0.8, speed=6.0))
    spec = ResetSpec(**CONTROL, seed=9, randomization=ALL, **SPAWNING)
    entries = [Entry("reset", 0, reset_payload(spec))]
    entries += [Entry("action", k, action_payload(COAST)) for k in range(10)]
    made = record(Replayer.on(scene, ScenarioState.of(scene)), entries, scene_hash="h")
    read = recording_of_bytes(to_bytes(made), "it")
    assert read.drawn == made.drawn
    assert {"start.lateral", "agents.spawned:1.desired_speed"} <= set(read.drawn)
    assert first_difference(read, Replayer.on(scene, ScenarioState.of(scene))) is None
