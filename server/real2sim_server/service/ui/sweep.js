// The LiDAR sweep: requested when the time rests, drawn on the map and in the picture.
import { model, on, emit } from "./model.js";
import { call, get } from "./api.js";
import { project } from "./poses.js";
import { attempt } from "./messages.js";

const $ = (id) => document.getElementById(id);
const REST_MS = 150;
const NUMBERS = 4; // x, y, z in the world [m], intensity
const FAR = 60; // of the colours [m]
let waiting;
let asked = 0;

export async function startSweep() {
  $("lidar").onchange = () => chooseLidar($("lidar").value);
  on("time scenario run", later);
  const { lidar_models: names = [] } = await get("/v1/server");
  for (const name of names) {
    $("lidar").append(new Option(name, name));
  }
}
export function chooseLidar(name) {
  $("lidar").value = name;
  model.lidar = name || null;
  emit("lidar");
  later();
}
// Points of another time are not shown.
function later() {
  clearTimeout(waiting);
  asked += 1;
  if (model.sweep) {
    model.sweep = null;
    emit("sweep");
  }
  if (model.lidar && !model.job && !model.live) {
    waiting = setTimeout(attempt(ask), REST_MS);
  }
}
async function ask() {
  const mine = asked;
  const query = new URLSearchParams({ lidar: model.lidar, t_us: model.t });
  const path = `/v1/scenarios/${model.scenario.scenario_id}/sweep?${query}`;
  const answer = await call("GET", path, { accept: "application/octet-stream" });
  const points = new Float32Array(await answer.arrayBuffer());
  if (mine === asked) {
    model.sweep = points;
    emit("sweep");
  }
}

// Near points are warm, far ones cold.
const COLOURS = Array.from({ length: 32 }, (_, k) => `hsl(${(250 * k) / 31} 95% 60%)`);
function colourAt(distance) {
  const level = Math.min(1, Math.sqrt(Math.max(0, distance) / FAR));
  return COLOURS[Math.round(level * (COLOURS.length - 1))];
}

// All points sorted by colour, to change the colour rarely.
function drawn(pen, size, placesOf) {
  const buckets = new Map();
  for (let i = 0; i < model.sweep.length; i += NUMBERS) {
    const found = placesOf(model.sweep.subarray(i, i + 3));
    if (found) {
      const [x, y, distance] = found;
      const colour = colourAt(distance);
      (buckets.get(colour) ?? buckets.set(colour, []).get(colour)).push(x, y);
    }
  }
  for (const [colour, places] of buckets) {
    pen.fillStyle = colour;
    for (let i = 0; i < places.length; i += 2) {
      pen.fillRect(places[i] - size / 2, places[i + 1] - size / 2, size, size);
    }
  }
}

export function drawSweepAbove(pen, toScreen, { position: ego }) {
  if (!model.sweep) {
    return;
  }
  const { clientWidth: width, clientHeight: height } = pen.canvas;
  drawn(pen, 1.4, (point) => {
    const [x, y] = toScreen(point);
    const inside = x >= 0 && y >= 0 && x < width && y < height;
    return inside && [x, y, Math.hypot(point[0] - ego[0], point[1] - ego[1])];
  });
}

// header: of the picture; box: its rectangle on the stage.
export function drawSweepInPicture(pen, header, { scale, left, top }) {
  if (!model.sweep) {
    return;
  }
  const [ex, ey, ez] = [3, 7, 11].map((i) => header.T_world_camera[i]);
  drawn(pen, 1.6, (point) => {
    const pixel = project(point, header.T_world_camera, header.K);
    if (!pixel || pixel[0] < 0 || pixel[1] < 0) {
      return null;
    }
    if (pixel[0] >= header.width || pixel[1] >= header.height) {
      return null;
    }
    const distance = Math.hypot(point[0] - ex, point[1] - ey, point[2] - ez);
    return [left + pixel[0] * scale, top + pixel[1] * scale, distance];
  });
}
