// The state of the studio in the address, so that a link opens the same view.
import { model, on, isRecorded } from "./model.js";
export const addressParameters = () => Object.fromEntries(new URLSearchParams(location.search));
let waiting = null;
export function startAddress() {
  on("scenario selection time camera space run mosaic lidar", () => {
    waiting ??= setTimeout(write, 250);
  });
  write();
}
function write() {
  waiting = null;
  const values = {
    scene: model.scenario.scene,
    scenario: isRecorded() ? null : model.scenario.scenario_id,
    camera: model.mosaic ? "*" : model.camera,
    t: model.t,
    selected: model.selected,
    run: model.job,
    shows: model.shows === "rgb" ? null : model.shows,
    lidar: model.lidar,
    space: model.space ? 1 : null,
  };
  const query = new URLSearchParams(Object.entries(values).filter(([, v]) => v !== null));
  history.replaceState(null, "", `?${query}`);
}
