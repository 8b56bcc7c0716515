"""A cut-in of your own: driven by a planner without a worker, and exported as OpenSCENARIO."""

from pathlib import Path

from real2sim.planners import load_planner
from real2sim_proto.cases import (
    actor,
    case,
    change_lane,
    completed,
    event,
    in_lane,
    reached,
    speed_to,
)
from real2sim_server.scenarios.openscenario import write_openscenario
from real2sim_server.sweeps.episode import Drive, drive_episode
from real2sim_server.sweeps.spec import open_scene, run_options

# A car comes from 15 m behind on the left, moves in 8 m ahead of the ego, and stops there.
past = reached("cutter", in_lane(8.0, lane=1))
move_in = event("move_in", past, change_lane(0, seconds=2.0))
stop = event("stop", completed("move_in"), speed_to(0.0, rate=6.0))
CASE = case(actor("cutter", in_lane(-15.0, lane=1), 12.0, move_in, stop), name="My cut-in")


def main() -> None:
    """Drive the case on the demo street with the intelligent driver model."""
    drive = Drive("idm", run_options(CASE, seed=0, seconds=15.0))
    driven = drive_episode(open_scene("demo_street"), drive, load_planner("idm"))
    if driven.world is None:
        raise SystemExit(driven.error)
    print(f"My cut-in: {driven.world.reason}, smallest gap {driven.danger.gap:.1f} m")
    Path("own_case.xosc").write_bytes(write_openscenario(CASE))


if __name__ == "__main__":
    main()
