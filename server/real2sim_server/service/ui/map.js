// The map from above. `map_hands` handles dragging and turning.
import { model, on, object, isHere, poseOf, egoPoseAt } from "./model.js";
import { yawOf } from "./poses.js";
import { fromAbove } from "./colliders.js";
import { drawSweepAbove } from "./sweep.js";
import { drawLanes } from "./lanes.js";
import { colourOf } from "./categories.js";
import { ink, onTheme } from "./theme.js";
import { startMapHands } from "./map_hands.js";
import {
  view,
  toScreen,
  useCanvas,
  shown,
  keepInView,
  lookAtEverything,
  lookAtSelection,
} from "./map_view.js";

let canvas;
let pen;
const layers = [];
// Other modules draw on the map too, after the objects. They get the context and a function from
// metres to pixels.
export const addLayer = (layer) => layers.push(layer);

export function startMap() {
  canvas = document.getElementById("map");
  pen = canvas.getContext("2d");
  useCanvas(canvas);
  startMapHands(canvas, draw);
  on("scenario selection time draft run camera box sweep drive-step layout", draw);
  onTheme(draw);
  new ResizeObserver(draw).observe(canvas);
  centre();
}
export const screenOfBox = () => toScreen(model.box.position);
export const screenOf = (id) => toScreen(poseOf(object(id)).position);
export function fit() {
  lookAtEverything();
  draw();
}
// The map follows the driven vehicle.
export function follow(position) {
  keepInView(position);
  draw();
}
export function centre() {
  lookAtSelection();
  draw();
}

function draw() {
  const ratio = devicePixelRatio;
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.fillStyle = ink().ground;
  pen.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  grid();
  if (model.lanes) {
    drawLanes(pen, toScreen, model.lanes);
  }
  line(model.scene.ego.positions, ink().way, 2);
  drawSweepAbove(pen, toScreen, egoPoseAt(model.t));
  for (const o of shown()) {
    if (o.trajectory?.positions.length > 1) {
      line(
        o.trajectory.positions,
        o.object_id === model.selected ? `${ink().selected}99` : ink().other,
        1.2,
      );
    }
  }
  for (const region of model.scenario.erased) {
    box(region.pose, region.size, ink().erased, false);
  }
  for (const { shape } of model.scenario.colliders) {
    const { size, lines = [] } = fromAbove(shape);
    if (size) {
      box(shape, size, ink().collider, false);
    }
    lines.forEach((corners) => line(corners, `${ink().collider}80`, 1));
  }
  if (!model.selected && model.box && !model.live && !model.job) {
    pen.setLineDash([4, 4]);
    box(model.box, model.box.size, ink().text, false);
    pen.setLineDash([]);
  }
  for (const o of shown()) {
    box(
      poseOf(o),
      o.size,
      o.object_id === model.selected ? ink().selected : colourOf(o),
      true,
      o.object_id,
    );
  }
  const ego = egoPoseAt(model.t);
  const yaw = yawOf(ego.quaternion);
  const p = ego.position;
  box(
    {
      position: [p[0] + 1.4 * Math.cos(yaw), p[1] + 1.4 * Math.sin(yaw), 0],
      quaternion: ego.quaternion,
    },
    [4.6, 1.9, 1.5],
    ink().ego,
    true,
    model.live || model.playback?.ego ? "driven vehicle" : "recording vehicle",
  );
  layers.forEach((layer) => layer(pen, toScreen, { line, box }));
  const subject = object(model.selected);
  if (subject && isHere(subject) && !model.job) {
    handle();
  }
}
function grid() {
  const step = view.scale > 14 ? 5 : view.scale > 5 ? 10 : 50;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  pen.fillStyle = ink().faint;
  pen.strokeStyle = ink().grid;
  pen.lineWidth = 1;
  pen.font = "10px system-ui";
  for (
    let x = Math.ceil((view.x - w / 2 / view.scale) / step) * step, [sx] = toScreen([x, 0]);
    sx < w;
    x += step, [sx] = toScreen([x, 0])
  ) {
    pen.beginPath();
    pen.moveTo(sx, 0);
    pen.lineTo(sx, h);
    pen.stroke();
    pen.fillText(`${x} m`, sx + 3, h - 4);
  }
  for (
    let y = Math.ceil((view.y - h / 2 / view.scale) / step) * step, [, sy] = toScreen([0, y]);
    sy > 0;
    y += step, [, sy] = toScreen([0, y])
  ) {
    pen.beginPath();
    pen.moveTo(0, sy);
    pen.lineTo(w, sy);
    pen.stroke();
  }
}
function line(points, colour, width) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  points.forEach((p, i) => (i ? pen.lineTo(...toScreen(p)) : pen.moveTo(...toScreen(p))));
  pen.stroke();
}
function box(pose, size, colour, front, label) {
  const [x, y] = toScreen(pose.position);
  const [l, w] = [size[0] * view.scale, size[1] * view.scale];
  pen.save();
  pen.translate(x, y);
  pen.rotate(-yawOf(pose.quaternion ?? [1, 0, 0, 0]));
  pen.strokeStyle = colour;
  pen.fillStyle = `${colour}33`;
  pen.lineWidth = label === model.selected ? 2.2 : 1.4;
  pen.fillRect(-l / 2, -w / 2, l, w);
  pen.strokeRect(-l / 2, -w / 2, l, w);
  if (front) {
    pen.beginPath();
    pen.moveTo(l / 2 - Math.min(l, w) * 0.35, -w / 2);
    pen.lineTo(l / 2, 0);
    pen.lineTo(l / 2 - Math.min(l, w) * 0.35, w / 2);
    pen.stroke();
  }
  pen.restore();
  if (label && (view.scale > 7 || label === model.selected)) {
    pen.fillStyle = colour;
    pen.font = "11px system-ui";
    pen.fillText(label, x + 6, y - w / 2 - 6);
  }
}
export function handleAt() {
  const subject = object(model.selected);
  const { position, quaternion } = poseOf(subject);
  const yaw = yawOf(quaternion);
  const reach = subject.size[0] / 2 + 22 / view.scale;
  return toScreen([position[0] + reach * Math.cos(yaw), position[1] + reach * Math.sin(yaw)]);
}
function handle() {
  const [x, y] = handleAt();
  pen.strokeStyle = ink().selected;
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(...screenOf(model.selected));
  pen.lineTo(x, y);
  pen.stroke();
  pen.fillStyle = ink().ground;
  pen.beginPath();
  pen.arc(x, y, 6, 0, 7);
  pen.fill();
  pen.stroke();
}
