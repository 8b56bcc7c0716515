// Camera tabs, and all cameras at once.
import { model, on, emit } from "./model.js";
import { picture } from "./api.js";
import { pictureOf } from "./drive_session.js";
import { attempt } from "./messages.js";

const $ = (id) => document.getElementById(id);
const WIDTH = 400;
let busy = false;
let again = false;

export function startMosaic() {
  const names = inOrder().map((c) => c.name);
  $("cameras").replaceChildren(
    ...names.map((name) => tab(name, name)),
    ...(names.length > 1 ? [tab("All cameras", null)] : []),
  );
  on("time scenario run mosaic", attempt(draw));
  mark();
}
// Clockwise order: forward cameras from left to right, then backward ones.
function inOrder() {
  const aside = ({ T_vehicle_camera: T }) => Math.atan2(T[1][2], T[0][2]);
  const ahead = (camera) => Math.abs(aside(camera)) <= Math.PI / 2 + 0.01;
  const left = (a, b) => aside(b) - aside(a);
  const { cameras } = model.scene;
  const back = cameras.filter((c) => !ahead(c)).sort(left);
  return [...cameras.filter(ahead).sort(left), ...back];
}
function tab(label, name) {
  const button = document.createElement("button");
  button.textContent = label;
  button.dataset.camera = name ?? "*";
  button.onclick = () => choose(name);
  return button;
}
export function choose(name) {
  model.mosaic = name === null;
  if (name) {
    model.camera = name;
    model.free = null;
    $("free").classList.remove("on");
    $("free").setAttribute("aria-pressed", false);
    $("stage").classList.remove("free");
  }
  mark();
  emit("mosaic");
  emit("camera");
}
function mark() {
  $("mosaic").hidden = !model.mosaic;
  for (const b of $("cameras").children) {
    const chosen = b.dataset.camera === (model.mosaic ? "*" : model.camera);
    b.classList.toggle("on", chosen);
    b.setAttribute("aria-pressed", chosen);
  }
}
async function draw() {
  if (!model.mosaic) {
    return;
  }
  if (busy) {
    again = true;
    return;
  }
  busy = true;
  try {
    for (const { name } of inOrder()) {
      tile(name, await pictureFrom(name));
    }
  } finally {
    busy = false;
  }
  if (again) {
    again = false;
    draw();
  }
}
// Pictures of the watched drive, the played run, or the scenario.
async function pictureFrom(camera) {
  if (model.live) {
    return URL.createObjectURL(await pictureOf(model.live.session_id, camera, WIDTH));
  }
  const base = model.job ? `/v1/jobs/${model.job}` : `/v1/scenarios/${model.scenario.scenario_id}`;
  const query = `camera=${encodeURIComponent(camera)}&t_us=${model.t}&width=${WIDTH}`;
  return picture(`${base}/preview?${query}`);
}
function tile(name, src) {
  let figure = [...$("mosaic").children].find((f) => f.dataset.camera === name);
  if (!figure) {
    figure = document.createElement("figure");
    figure.dataset.camera = name;
    const caption = document.createElement("figcaption");
    caption.textContent = name;
    const image = document.createElement("img");
    image.alt = name;
    figure.append(image, caption);
    figure.onclick = () => choose(name);
    $("mosaic").append(figure);
  }
  const image = figure.querySelector("img");
  if (image.src) {
    URL.revokeObjectURL(image.src);
  }
  image.src = src;
}
