// The 3D view: the page renders the scene itself, at the display's rate.
import { model, on, emit, object, poseOf, egoPoseAt } from "./model.js";
import { rotate, present } from "./poses.js";
import { attempt, notify } from "./messages.js";
import { colourOf } from "./categories.js";
import { addPictureLayer, showSpace, requestPicture, strokeBox } from "./camera_view.js";
import { startSpaceHands, ringOf } from "./space_hands.js";
import { ink } from "./theme.js";

const $ = (id) => document.getElementById(id);
let world = null;
// Number of Gaussians per request of an object.
const MOST = 262_144;

export function startSpace() {
  $("space-mode").onclick = attempt(toggleSpace);
  on("time draft scenario run", place);
  on("camera", () => seen() && !model.remote && world.moved());
  on("selection layout mosaic", redraw);
  on("mosaic run camera", show);
  new ResizeObserver(redraw).observe($("stage"));
  addPictureLayer(drawLines);
  addPictureLayer(drawBoxes);
  addPictureLayer(drawRing);
  startSpaceHands($("space"), () => view());
}
export async function toggleSpace() {
  model.space = !model.space;
  if (model.space && !(await begun())) {
    model.space = false;
  }
  model.free = model.space ? (model.free ?? recorded()) : null;
  show();
  emit("space");
  emit("camera");
  if (!model.space) {
    requestPicture();
  }
}
const hasWebGl = () => !!document.createElement("canvas").getContext("webgl2");
// Whether the renderer is available; loaded on first use.
async function begun() {
  if (world) {
    return true;
  }
  if (!hasWebGl()) {
    notify("This browser has no WebGL2, so the worker's picture is shown. Press F to fly.", "warm");
    return false;
  }
  const { SplatWorld } = await import("./splat_world.js");
  world = new SplatWorld($("space"), model.scene, { draw, again: place });
  place();
  attempt(async () => {
    if (await world.load()) {
      $("space").dataset.whole = "yes";
    } else {
      leaveToWorker();
    }
  })();
  return true;
}
// Use the worker's pictures instead, with the same camera; input and overlays stay the same.
function leaveToWorker() {
  model.remote = true;
  $("space").classList.add("remote");
  notify(
    "This browser renders without a GPU, so 3D shows the worker's picture.",
    "warm",
  );
  if (model.space) {
    requestPicture();
  }
}
const seen = () => world && model.space && !model.mosaic && !model.live;
function show() {
  if (model.space && !model.free) {
    model.free = recorded();
  }
  $("space").hidden = !seen();
  $("space-mode").classList.toggle("on", model.space);
  $("space-mode").setAttribute("aria-pressed", model.space);
  redraw();
}
// Pose of the selected camera at the current time.
function recorded() {
  const { position, quaternion } = egoPoseAt(model.t);
  const { T_vehicle_camera: C } = camera();
  const columns = [0, 1, 2, 3].map((k) => rotate(quaternion, [C[0][k], C[1][k], C[2][k]]));
  const row = (i) => [columns[0][i], columns[1][i], columns[2][i], columns[3][i] + position[i]];
  return [...row(0), ...row(1), ...row(2), 0, 0, 0, 1];
}
const camera = () => model.scene.cameras.find((c) => c.name === model.camera);
// The stage as a camera: the recorded camera, fitted, and wider at the sides.
export function view() {
  const { K, width, height } = camera();
  const { clientWidth: w, clientHeight: h } = $("stage");
  const scale = Math.min(w / width, h / height);
  const [cx, cy] = [w / 2 + (K[0][2] - width / 2) * scale, h / 2 + (K[1][2] - height / 2) * scale];
  return {
    width: w,
    height: h,
    ratio: Math.min(2, devicePixelRatio),
    K: [K[0][0] * scale, 0, cx, 0, K[1][1] * scale, cy, 0, 0, 1],
    T: model.free,
  };
}
function place() {
  if (model.remote) {
    return;
  }
  world?.place(
    model.scenario.objects
      .filter((o) => present(o, model.t))
      .map((o) => ({ id: o.object_id, ...lookOf(o), ...poseOf(o) })),
  );
}
// Scale relative to the recording; null if not recorded or not uniform.
function scaleOf({ recorded_id: id, size }) {
  const before = model.scene.objects.find((o) => o.object_id === id);
  const [a, b, c] = size.map((side, axis) => side / before?.size[axis]);
  const even = Math.max(a, b, c) - Math.min(a, b, c) < 0.01 * a;
  return even ? a : null;
}
// Gaussians as recorded, or as in the scenario: another asset, stretched, or in mid-stride.
function lookOf(subject) {
  const { object_id: id, recorded_id: source, asset_id: asset, size } = subject;
  const who = source ? `recorded ${source}` : `asset ${asset}`;
  const scale = scaleOf(subject);
  const fleeting = world.walking.has(who);
  if (scale && !fleeting) {
    const path = world.url("splats", { object_id: source, count: MOST, up_axis: "z" });
    return { scale, look: { key: who, who, path } };
  }
  const { scenario_id: scenario, revision } = model.scenario;
  const query = new URLSearchParams({ object_id: id, t_us: model.t, up_axis: "z" });
  const path = `/v1/scenarios/${encodeURIComponent(scenario)}/splats?${query}`;
  const key = fleeting ? `${scenario} ${revision} ${id} ${model.t}` : `${who} ${size}`;
  return { scale: 1, look: { key, who, path, fleeting } };
}
// Placeholder for objects whose Gaussians are not loaded.
function drawBoxes(pen, toStage) {
  if (!seen() || model.remote) {
    return;
  }
  const boxes = model.scenario.objects.filter(
    (o) => present(o, model.t) && world.isMissing(o.object_id),
  );
  $("space").dataset.boxes = boxes.map((o) => o.object_id).join(" ");
  pen.lineWidth = 1.4;
  for (const subject of boxes) {
    pen.strokeStyle = colourOf(subject);
    strokeBox(pen, subject, toStage);
  }
}
const redraw = () => seen() && !model.remote && world.request();
function draw() {
  if (!seen() || model.remote || !$("stage").clientHeight) {
    return;
  }
  const now = view();
  world.look(now);
  world.draw();
  showSpace({ width: now.width, height: now.height, K: now.K, T_world_camera: now.T });
  tell();
}
// Fraction of the scene in the picture; numbers are in the page's data attributes.
function tell() {
  const { pace, loading, received } = world;
  const [shown, total] = [pace.detail.shown, world.total()];
  const share = Math.round((100 * shown) / Math.max(1, total));
  const whole = pace.whole();
  const coarse = whole ? "" : ` · ${share} % while it moves`;
  $("rate").textContent = loading ? `3D · part ${received.parts}` : `3D${coarse}`;
  const { dataset } = $("space");
  Object.assign(dataset, { shown, total, detail: whole ? "whole" : "part" });
  dataset.drawn = Number(dataset.drawn ?? 0) + 1;
}
const line = (pen, points) => {
  pen.beginPath();
  let open = false;
  for (const p of points) {
    if (!p) {
      open = false;
    } else if (open) {
      pen.lineTo(...p);
    } else {
      pen.moveTo(...p);
      open = true;
    }
  }
  pen.stroke();
};
function drawLines(pen, toStage) {
  if (!seen()) {
    return;
  }
  pen.lineWidth = 1.4;
  for (const { object_id: id, trajectory, size } of model.scenario.objects) {
    pen.strokeStyle = id === model.selected ? ink().selected : ink().faint;
    pen.globalAlpha = id === model.selected ? 1 : 0.55;
    line(
      pen,
      trajectory.positions.map(([x, y, z]) => toStage([x, y, z - size[2] / 2])),
    );
  }
  pen.globalAlpha = 0.8;
  pen.strokeStyle = ink().ego;
  line(pen, model.scene.ego.positions.map(toStage));
  drawFrusta(pen, toStage);
  pen.globalAlpha = 1;
}
function drawFrusta(pen, toStage) {
  const { position, quaternion } = egoPoseAt(model.t);
  const inWorld = (p) => rotate(quaternion, p).map((v, i) => v + position[i]);
  for (const { K, T_vehicle_camera: C, width, height } of model.scene.cameras) {
    const at = (x, y, z) =>
      toStage(inWorld([0, 1, 2].map((i) => C[i][0] * x + C[i][1] * y + C[i][2] * z + C[i][3])));
    // The frame of the camera that is looked through is not drawn.
    const eye = inWorld([C[0][3], C[1][3], C[2][3]]);
    if (Math.hypot(...eye.map((v, i) => v - model.free[4 * i + 3])) < 1.2) {
      continue;
    }
    const corner = (u, v) => at((u - K[0][2]) / K[0][0], (v - K[1][2]) / K[1][1], 1);
    const rim = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
    line(pen, [...rim, rim[0]]);
    rim.forEach((c) => line(pen, [at(0, 0, 0), c]));
  }
}
function drawRing(pen, toStage) {
  const subject = object(model.selected);
  if (seen() && !model.job && subject && present(subject, model.t)) {
    pen.lineWidth = 3;
    pen.strokeStyle = ink().selected;
    line(pen, ringOf(subject).map(toStage));
  }
}
