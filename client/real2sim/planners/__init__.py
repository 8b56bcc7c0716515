"""Planners and the loop that runs them.

A planner is any class with ``reset(obs)`` and ``plan(obs)``. This one keeps the wheel straight
and drives at 5 m/s::

    import real2sim
    from real2sim.planners import run_episode

    class Cruise:
        def reset(self, obs):
            pass

        def plan(self, obs):
            return real2sim.Control(acceleration=5.0 - obs.ego.speed, steering=0.0)

    with real2sim.connect() as client, client.session(scene="street") as session:
        summary = run_episode(session, Cruise(), steps=50, action="control")
    print(summary.reason, summary.distance, summary.stages["step"].p50)

Saved as ``my.py`` (only the class), it also runs as ``real2sim drive --planner my:Cruise``.
"""

from .depth_sampling import DepthSampling
from .follow_route import FollowRoute
from .idm import Idm
from .learned import LearnedPolicy
from .pid import PidFollowRoute
from .planner import (
    EpisodeSummary,
    Needs,
    Planner,
    StageTimes,
    UnknownPlannerError,
    load_planner,
    needs_of,
    run_episode,
)

__all__ = [
    "DepthSampling",
    "EpisodeSummary",
    "FollowRoute",
    "Idm",
    "LearnedPolicy",
    "Needs",
    "PidFollowRoute",
    "Planner",
    "StageTimes",
    "UnknownPlannerError",
    "load_planner",
    "needs_of",
    "run_episode",
]
