"""A car cuts in front of two planners.

Needs a worker: ``real2sim serve --demo``.
"""

import real2sim
from real2sim.planners import FollowRoute, Idm, run_episode


def main() -> None:
    """Drive the corner case with both planners and print the results."""
    with real2sim.connect() as sim:
        scenario = sim.scenarios.create(scene="demo_street", name="cut-in")
        scenario.apply_corner_case("cut_in", gap=8.0)  # [m]
        for planner in (FollowRoute(speed=8.0), Idm()):
            with sim.session(scenario=scenario) as session:
                summary = run_episode(session, planner, seed=0, privileged=True)
            name = type(planner).__name__
            print(f"{name}: {summary.reason}, {summary.distance:.1f} m, {summary.metrics}")


if __name__ == "__main__":
    main()
