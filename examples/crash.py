"""Push a parked car into its neighbour and record a film of the crash.

Needs a worker: ``real2sim serve --demo``. Writes ``crash.webm``.
"""

from pathlib import Path

import real2sim


def main() -> None:
    """Simulate half a second of physics, print the contacts and export a film."""
    with real2sim.connect() as sim:
        scenario = sim.scenarios.create(scene="demo_street", name="crash")
        car = scenario.objects["car_6"]
        car.set_velocity(linear=(8.0, 0.0, 0.0))  # [m/s], world frame
        end_us = sim.scenes["demo_street"].start_us + 500_000
        run = scenario.simulate(objects=["car_6"], end_us=end_us, max_particles=4000).wait()
        for contact in run.result["contacts"]:
            dv = contact["impact_delta_v"]
            print(f"{contact['object_id']} hits {contact['other']}: delta v {dv:.1f} m/s")
        film = sim.jobs.export_video(simulation=run, camera="front", width=480).wait()
        film.download(film.info.files[0].name, Path("crash.webm"))


if __name__ == "__main__":
    main()
