// The camera picture: requests frames, selects on click, outlines the selection, flies freely.
import {
  model,
  on,
  emit,
  object,
  isHere,
  poseOf,
  draftOperations,
  select,
  refresh,
} from "./model.js";
import { ViewSocket } from "./view_socket.js";
import { project, rotate } from "./poses.js";
import { attempt, notify } from "./messages.js";
import { drawSweepInPicture } from "./sweep.js";
import { startFlight } from "./flight.js";
import { ink } from "./theme.js";

const $ = (id) => document.getElementById(id);
const MOVING_WIDTH = 640;
const STILL_WIDTH = 1600;
const STILL_AFTER_MS = 180;
let socket;
let header;
let url;
let still;
let arrivals = [];
const layers = [];
// Other modules draw over the picture too. They get the context and a function from metres to
// pixels of the stage (null behind the camera).
export const addPictureLayer = (layer) => layers.push(layer);

export function startView() {
  socket = new ViewSocket(model.scenario.scenario_id, {
    onFrame: show,
    onPick: select,
    onChanged: attempt(refresh),
    onError: (text) => notify(text, "bad"),
    onGone: (gone) => ($("gone").hidden = !gone),
  });
  on("begun", () => socket.turnTo(model.scenario.scenario_id));
  on("time draft camera", () => requestFrame(true));
  on("scenario run", () => requestFrame(false));
  on("selection draft scenario sweep layout", outline);
  new ResizeObserver(() => requestFrame(false)).observe($("stage"));
  new ResizeObserver(outline).observe($("stage"));
  $("uncertainty").hidden = !model.scene.has_uncertainties;
  pressed("uncertainty", model.shows !== "rgb");
  startFlight($("stage"), (e) => !model.mosaic && pickAt(e));
  requestFrame(false);
}

function viewRequest(width) {
  return {
    camera: model.camera,
    t_us: model.t,
    width,
    job: model.job,
    shows: model.shows,
    T_world_camera: model.free,
    operations: model.job ? [] : draftOperations(),
  };
}

const drawnHere = () => model.space && !model.remote;

// Small pictures while something moves, a full one afterwards.
function requestFrame(moving) {
  clearTimeout(still);
  if (model.mosaic || model.live || drawnHere()) {
    return;
  }
  if (moving) {
    socket.requestFrame(viewRequest(Math.min(MOVING_WIDTH, fullWidth())));
  }
  still = setTimeout(
    () => socket.requestFrame(viewRequest(fullWidth())),
    moving ? STILL_AFTER_MS : 0,
  );
}
// Gaussians have no pixels of their own, so the final picture has the resolution of the stage.
function fullWidth() {
  const { width, height } = model.scene.cameras.find((c) => c.name === model.camera);
  const { clientWidth, clientHeight } = $("stage");
  const fitting = Math.min(clientWidth, (clientHeight * width) / height) * devicePixelRatio;
  return Math.round(Math.max(64, Math.min(fitting, STILL_WIDTH)));
}

function show(head, blob) {
  if (model.live || drawnHere()) {
    return;
  }
  header = head;
  const old = url;
  url = URL.createObjectURL(blob);
  $("picture").onload = () => old && URL.revokeObjectURL(old);
  $("picture").src = url;
  $("picture").dataset.seq = head.seq;
  // A picture may be the first sign of another client's edit.
  if (head.revision > model.scenario.revision) {
    socket.onChanged();
  }
  const now = performance.now();
  arrivals = [...arrivals.filter((t) => now - t < 1000), now];
  $("rate").textContent =
    arrivals.length > 2
      ? `${arrivals.length} fps · ${head.width}×${head.height}`
      : `${head.width}×${head.height}`;
  outline();
}

// A picture of a driven session, without overlays: it comes without a pose.
export function showLive(blob, goesOn) {
  if (!goesOn()) {
    return;
  }
  clearTimeout(still);
  header = null;
  const old = url;
  url = URL.createObjectURL(blob);
  $("picture").onload = () => old && URL.revokeObjectURL(old);
  $("picture").src = url;
  $("rate").textContent = "live";
  outline();
}

// For pictures rendered by the page; head: size [css px], K and T_world_camera.
export function showSpace(head) {
  header = head;
  outline();
}
export const requestPicture = () => requestFrame(false);

// Rectangle of the picture inside the stage, fitted with its aspect ratio.
function frameBox() {
  const { clientWidth: w, clientHeight: h } = $("stage");
  const scale = Math.min(w / header.width, h / header.height);
  return { scale, left: (w - header.width * scale) / 2, top: (h - header.height * scale) / 2 };
}

function toStage(point) {
  const pixel = project(point, header.T_world_camera, header.K);
  const { scale, left, top } = frameBox();
  return pixel && [left + pixel[0] * scale, top + pixel[1] * scale];
}
// Centre of an object on the stage [CSS px]; null if it is not visible.
export const stagePlace = (id) => toStage(poseOf(object(id)).position);

function outline() {
  const canvas = $("overlay");
  canvas.width = canvas.clientWidth * devicePixelRatio;
  canvas.height = canvas.clientHeight * devicePixelRatio;
  const subject = object(model.selected);
  $("stage-hint").textContent = subject
    ? subject.object_id
    : model.live
      ? "Live"
      : model.free || model.mosaic
        ? ""
        : "Click an object to select it";
  if (!header) {
    return;
  }
  const { scale, left, top } = frameBox();
  const pen = canvas.getContext("2d");
  pen.scale(devicePixelRatio, devicePixelRatio);
  drawSweepInPicture(pen, header, { scale, left, top });
  pen.save();
  pen.beginPath();
  pen.rect(left, top, header.width * scale, header.height * scale);
  pen.clip();
  layers.forEach((layer) => layer(pen, toStage));
  pen.restore();
  if (!subject || !isHere(subject)) {
    return;
  }
  pen.strokeStyle = ink().selected;
  pen.lineWidth = 1.6;
  strokeBox(pen, subject, toStage);
}
export function strokeBox(pen, subject, placeOf) {
  const { position, quaternion } = poseOf(subject);
  const corners = [...Array(8).keys()].map((i) => {
    const offset = subject.size.map((s, axis) => ((i >> axis) & 1 ? s : -s) / 2);
    return placeOf(rotate(quaternion, offset).map((v, k) => v + position[k]));
  });
  for (let a = 0; a < 8; a++) {
    for (const bit of [1, 2, 4]) {
      const b = a | bit;
      if (b === a || !corners[a] || !corners[b]) {
        continue;
      }
      pen.beginPath();
      pen.moveTo(...corners[a]);
      pen.lineTo(...corners[b]);
      pen.stroke();
    }
  }
}

// Only for scenes that have it.
export function toggleUncertainty() {
  if (model.scene.has_uncertainties) {
    model.shows = model.shows === "rgb" ? "uncertainty" : "rgb";
    pressed("uncertainty", model.shows !== "rgb");
    emit("camera");
  }
}

export function toggleFree() {
  if (model.space) {
    return;
  }
  model.free = model.free ? null : (header?.T_world_camera?.slice() ?? null);
  pressed("free", !!model.free);
  $("stage").classList.toggle("free", !!model.free);
  emit("camera");
}

const pressed = (id, on_) => {
  $(id).classList.toggle("on", on_);
  $(id).setAttribute("aria-pressed", on_);
};

// Ask the worker for the object at a click or tap.
function pickAt(e) {
  if (!header) {
    return;
  }
  const { scale, left, top } = frameBox();
  const box = $("stage").getBoundingClientRect();
  const pick = [
    (e.clientX - box.left - left) / scale / header.width,
    (e.clientY - box.top - top) / scale / header.height,
  ];
  if (pick.every((v) => v >= 0 && v <= 1)) {
    socket.pick({ ...viewRequest(MOVING_WIDTH), pick });
  }
}
