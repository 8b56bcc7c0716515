"""The contract of metrics, for all built-in metrics and a custom one."""

import json
import math

import pytest

from real2sim_proto.plans import TrajectoryPlan
from real2sim_server.world.scoring import METRICS, MetricValue, metric, scores_of

NAME = "mean_headway"


@pytest.fixture
def headway():
    """Mean time gap to the object ahead, a metric with its own state (sum, count)."""

    def begin(_instant, _context):
        return 0.0, 0

    def update(state, instant, context):
        total, count = state
        ahead = instant.others.centres[:, 0] - instant.ego.x - context.centre_ahead
        if instant.ego.speed < 0.1 or not (ahead > 0).any():
            return state
        return total + float(ahead[ahead > 0].min()) / instant.ego.speed, count + 1

    def formula(accumulator, _context):
        total, count = accumulator.states[NAME]
        return MetricValue(total / count if count else None, missing=() if count else ("a leader",))

    metric(NAME, version="1", streamed=True, begin=begin, update=update)(formula)
    yield
    del METRICS[NAME]


@pytest.fixture
def driven(headway, make_world, moving):
    """A world after ten steps behind a car that stays 30 m ahead."""
    world = make_world(car=moving(30, 0, z=0.8, speed=10.0))
    for _ in range(10):
        times = [world.t_us + 100_000 * k for k in range(1, 6)]
        poses = [(1.0 * k, 0.0, 0.0) for k in range(1, 6)]
        world.step(TrajectoryPlan(times_us=times, poses=poses, frame="vehicle"))
    return world


def test_every_metric_has_a_value_or_names_missing_data(driven):
    for score in driven.scores():
        assert (score.value is None) == bool(score.missing), score.name
        assert score.value is None or math.isfinite(score.value), score.name


def test_every_score_is_json_serializable(driven):
    fields = [score.fields() for score in driven.scores()]

    assert json.loads(json.dumps(fields, allow_nan=False)) == fields


def test_scores_depend_only_on_accumulator_and_context(driven):
    assert scores_of(driven.accumulator, driven.context) == driven.scores()


def test_streamed_metrics_are_in_the_world_metrics(driven):
    streamed = {m.name for m in METRICS.values() if m.streamed}

    assert streamed <= driven.metrics().keys()


def test_streamed_values_match_the_scores(driven):
    shown = driven.metrics()

    scores = {s.name: s.value for s in driven.scores() if s.name in shown}
    assert len(scores) > 3
    assert {name: shown[name] for name in scores} == scores


def test_a_custom_metric_accumulates_its_own_state(driven):
    found = {s.name: s for s in driven.scores()}[NAME]

    assert found.value == pytest.approx((30.0 - driven.context.centre_ahead) / 10.0, rel=1e-3)


def test_a_fork_accumulates_independently(driven):
    before = driven.accumulator.states[NAME]
    driven.fork().step()

    assert driven.accumulator.states[NAME] == before


def test_registering_a_name_twice_is_refused():
    with pytest.raises(ValueError, match="pdms"):
        metric("pdms", version="3")(METRICS["pdms"].formula)


def test_metric_state_needs_both_begin_and_update():
    with pytest.raises(ValueError, match="both begin and update"):
        metric("half", version="1", begin=lambda instant, context: 0)
