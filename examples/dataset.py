"""Export an edited street as a labelled data set in KITTI's format.

Needs a worker: ``real2sim serve --demo``. Writes the archives into ``dataset/``.
"""

from pathlib import Path

import real2sim


def main() -> None:
    """Edit, export, and print the contents of the data set."""
    with real2sim.connect() as sim:
        scenario = sim.scenarios.create(scene="demo_street", name="data set")
        scenario.objects["car_6"].duplicate(x=-9.0, frame="object")
        scenario.objects["van_0"].delete()
        export = sim.jobs.export_dataset(
            scenario=scenario, formats=["kitti"], cameras=["front"], width=480, period_us=1_000_000
        ).wait()
        print(export.info.result["statistics"])
        folder = Path("dataset")
        folder.mkdir(exist_ok=True)
        for file in export.info.files:
            export.download(file.name, folder / file.name)


if __name__ == "__main__":
    main()
