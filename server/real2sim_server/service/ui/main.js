// Opens the view named by the address, or the first page.
import { addressParameters, startAddress } from "./address.js";
import { call } from "./api.js";
import {
  model,
  open,
  look,
  own,
  isRecorded,
  refresh,
  on,
  undo,
  redo,
  fork,
  exportFile,
  select,
  setTime,
} from "./model.js";
import { el } from "./dom.js";
import { attempt, notify } from "./messages.js";
import { startPage } from "./start.js";
import { startView, toggleFree, toggleUncertainty } from "./camera_view.js";
import { startSpace, toggleSpace } from "./space.js";
import { startMosaic } from "./mosaic.js";
import { startMap, fit, centre } from "./map.js";
import { startPanels, turnTo } from "./panels.js";
import { startLayout } from "./layout.js";
import { show } from "./physics.js";
import { startTimeline } from "./timeline.js";
import { startSweep, chooseLidar } from "./sweep.js";
import { startShortcuts } from "./shortcuts.js";

const $ = (id) => document.getElementById(id);

async function main() {
  const address = addressParameters();
  if (!address.scenario && !address.scene) {
    return startPage();
  }
  await (address.scenario ? open(address.scenario) : look(address.scene));
  const names = model.scene.cameras.map((c) => c.name);
  const { start_us: firstUs, end_us: lastUs } = model.scenario;
  model.camera = names.includes(address.camera) ? address.camera : forward();
  model.mosaic = address.camera === "*";
  if (address.shows === "uncertainty" && model.scene.has_uncertainties) {
    model.shows = address.shows;
  }
  model.t = Math.min(lastUs, Math.max(firstUs, Number(address.t ?? firstUs)));
  $("studio").hidden = false;
  [
    startPanels,
    startLayout,
    startMap,
    startTimeline,
    startMosaic,
    startView,
    startSpace,
    startShortcuts,
  ].forEach((start) => start());
  bar();
  if (model.scenario.objects.some((o) => o.object_id === address.selected)) {
    select(address.selected);
  }
  if (address.run) {
    const t = model.t;
    await attempt(show)(address.run);
    turnTo(model.playback?.kind === "drive" ? "drive" : "physics");
    setTime(t);
  }
  await attempt(startSweep)();
  if (address.lidar) {
    chooseLidar(address.lidar);
  }
  if (address.space) {
    await attempt(toggleSpace)();
  }
  startAddress();
  document.body.dataset.ready = "yes";
  return null;
}
// The forward camera.
function forward() {
  const aside = ({ T_vehicle_camera: T }) => Math.abs(Math.atan2(T[1][2], T[0][2]));
  return model.scene.cameras.toSorted((a, b) => aside(a) - aside(b))[0].name;
}
function bar() {
  const draw = () => {
    const s = model.scenario;
    const name = s.name || (isRecorded() ? s.scene : s.scenario_id);
    $("name").textContent = document.title = name;
    const where = isRecorded() ? "as recorded" : `on ${s.scene}`;
    $("subtitle").textContent = `${where} · ${s.objects.length} objects`;
    $("saved").textContent = isRecorded() ? "Nothing changed yet" : `kept · r${s.revision}`;
    $("undo").disabled = !s.can_undo;
    $("redo").disabled = !s.can_redo;
  };
  on("scenario", draw);
  draw();
  $("undo").onclick = undo;
  $("redo").onclick = redo;
  $("free").onclick = toggleFree;
  $("uncertainty").onclick = toggleUncertainty;
  $("fit").onclick = fit;
  $("centre").onclick = centre;
  $("rename").onclick = attempt(rename);
  $("fork").onclick = attempt(() =>
    copyAs(`${model.scenario.name || model.scenario.scene} (fork)`),
  );
  $("save").onclick = attempt(async () => {
    const name = prompt("Name", model.scenario.name);
    if (name) {
      await copyAs(name);
    }
  });
  $("download").onclick = attempt(download);
}
async function rename() {
  const name = prompt("Name", model.scenario.name)?.trim();
  if (name) {
    await call("PATCH", `/v1/scenarios/${await own()}`, { body: { name } });
    await refresh();
  }
}
async function copyAs(name) {
  const made = await fork(name);
  location.assign(`?scenario=${encodeURIComponent(made.scenario_id)}`);
}
async function download() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await exportFile());
  link.download = `${model.scenario.scenario_id}.scenario.json`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
// The page for a link to something that does not exist here.
function lost(error) {
  $("studio").hidden = true;
  $("lost").hidden = false;
  $("lost").replaceChildren(
    el("h1", { textContent: "This link leads to nothing here" }),
    el("p", { textContent: error.message }),
    el("p", {
      textContent:
        "The scenario may have been deleted or belong to another worker. Ask the sender of the link, or select another scenario.",
    }),
    el("a", { href: "./", textContent: "All scenarios and scenes" }),
  );
}
main().catch((error) => (error.status === 404 ? lost(error) : notify(error.message, "bad")));
