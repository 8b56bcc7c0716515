// Tabs of cameras, and all of them at once.
import { model, on, emit } from "./model.js";
import { picture } from "./api.js";

const $ = (id) => document.getElementById(id);
let busy = false;
let again = false;

export function startMosaic() {
  const names = model.scene.cameras.map((c) => c.name);
  $("cameras").replaceChildren(
    ...names.map((name) => tab(name, name)),
    ...(names.length > 1 ? [tab("All cameras", null)] : []),
  );
  on("time scenario run mosaic", draw);
  mark();
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
    $("stage").classList.remove("free");
  }
  mark();
  emit("mosaic");
  emit("camera");
}
function mark() {
  $("mosaic").hidden = !model.mosaic;
  for (const b of $("cameras").children) {
    b.classList.toggle("on", b.dataset.camera === (model.mosaic ? "*" : model.camera));
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
    const base = model.job
      ? `/v1/jobs/${model.job}`
      : `/v1/scenarios/${model.scenario.scenario_id}`;
    for (const { name } of model.scene.cameras) {
      const src = await picture(
        `${base}/preview?camera=${encodeURIComponent(name)}&t_us=${model.t}&width=400`,
      );
      tile(name, src);
    }
  } finally {
    busy = false;
  }
  if (again) {
    again = false;
    draw();
  }
}
function tile(name, src) {
  let figure = [...$("mosaic").children].find((f) => f.dataset.camera === name);
  if (!figure) {
    figure = document.createElement("figure");
    figure.dataset.camera = name;
    const caption = document.createElement("figcaption");
    caption.textContent = name;
    figure.append(document.createElement("img"), caption);
    figure.onclick = () => choose(name);
    $("mosaic").append(figure);
  }
  const image = figure.querySelector("img");
  if (image.src) {
    URL.revokeObjectURL(image.src);
  }
  image.src = src;
}
