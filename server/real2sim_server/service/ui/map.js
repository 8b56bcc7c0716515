// The map from above: world x to the right, y up. Drag moves, the handle ahead of a box turns it.
import { model, on, emit, object, poseOf, select, edit, draftOperations } from "./model.js";
import { yawOf, poseAt, present } from "./poses.js";
import { fromAbove } from "./colliders.js";
import { drawSweepAbove } from "./sweep.js";
import { drawLanes } from "./lanes.js";
import { colourOf } from "./categories.js";

let canvas;
let pen;
let view = { x: 0, y: 0, scale: 6 };
let drag = null;

export function startMap() {
  canvas = document.getElementById("map");
  pen = canvas.getContext("2d");
  canvas.addEventListener("pointerdown", down);
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("wheel", zoom, { passive: false });
  on("scenario selection time draft run camera box sweep", draw);
  new ResizeObserver(draw).observe(canvas);
  centre();
}
const toScreen = ([x, y]) => [
  canvas.clientWidth / 2 + (x - view.x) * view.scale,
  canvas.clientHeight / 2 - (y - view.y) * view.scale,
];
const toWorld = (e) => [
  view.x + (e.offsetX - canvas.clientWidth / 2) / view.scale,
  view.y - (e.offsetY - canvas.clientHeight / 2) / view.scale,
];
export const screenOfBox = () => toScreen(model.box.position);
export const screenOf = (id) => toScreen(poseOf(object(id)).position);

export function fit() {
  const points = [...(model.scene.ego?.positions ?? []), ...shown().map((o) => poseOf(o).position)];
  const [xs, ys] = [0, 1].map((k) => points.map((p) => p[k]));
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  view = {
    x: (x0 + x1) / 2,
    y: (y0 + y1) / 2,
    scale: Math.min(40, canvas.clientWidth / (x1 - x0 + 16), canvas.clientHeight / (y1 - y0 + 16)),
  };
  draw();
}
export function centre() {
  const subject = object(model.selected);
  const [x, y] = subject ? poseOf(subject).position : poseAt(model.scene.ego, model.t).position;
  view = { x: subject ? x : x + 18, y, scale: Math.max(view.scale, 9) };
  draw();
}
const shown = () => model.scenario.objects.filter((o) => present(o, model.t));

function draw() {
  const ratio = devicePixelRatio;
  canvas.width = canvas.clientWidth * ratio;
  canvas.height = canvas.clientHeight * ratio;
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.fillStyle = "#0f141c";
  pen.fillRect(0, 0, canvas.clientWidth, canvas.clientHeight);
  grid();
  if (model.lanes) {
    drawLanes(pen, toScreen, model.lanes);
  }
  line(model.scene.ego.positions, "#3f5a46", 2);
  drawSweepAbove(pen, toScreen, poseAt(model.scene.ego, model.t));
  for (const o of shown()) {
    if (o.trajectory.positions.length > 1) {
      line(o.trajectory.positions, o.object_id === model.selected ? "#ffb45499" : "#33425680", 1.2);
    }
  }
  for (const region of model.scenario.erased) {
    box(region.pose, region.size, "#ff7b72", false);
  }
  for (const { shape } of model.scenario.colliders) {
    const { size, lines = [] } = fromAbove(shape);
    if (size) {
      box(shape, size, "#8a97a8", false);
    }
    lines.forEach((corners) => line(corners, "#8a97a880", 1));
  }
  if (!model.selected && model.box) {
    pen.setLineDash([4, 4]);
    box(model.box, model.box.size, "#dbe2ec", false);
    pen.setLineDash([]);
  }
  for (const o of shown()) {
    box(
      poseOf(o),
      o.size,
      o.object_id === model.selected ? "#ffb454" : colourOf(o),
      true,
      o.object_id,
    );
  }
  const ego = poseAt(model.scene.ego, model.t);
  const yaw = yawOf(ego.quaternion);
  const p = ego.position;
  box(
    {
      position: [p[0] + 1.4 * Math.cos(yaw), p[1] + 1.4 * Math.sin(yaw), 0],
      quaternion: ego.quaternion,
    },
    [4.6, 1.9, 1.5],
    "#6fcf7c",
    true,
    "recording vehicle",
  );
  if (object(model.selected) && present(object(model.selected), model.t) && !model.job) {
    handle();
  }
}
function grid() {
  const step = view.scale > 14 ? 5 : view.scale > 5 ? 10 : 50;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  pen.fillStyle = "#5b6879";
  pen.strokeStyle = "#1a2230";
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
  pen.strokeStyle = "#ffb454";
  pen.lineWidth = 1.5;
  pen.beginPath();
  pen.moveTo(...screenOf(model.selected));
  pen.lineTo(x, y);
  pen.stroke();
  pen.fillStyle = "#0f141c";
  pen.beginPath();
  pen.arc(x, y, 6, 0, 7);
  pen.fill();
  pen.stroke();
}
function under([wx, wy]) {
  return shown()
    .filter((o) => {
      const { position, quaternion } = poseOf(o);
      const yaw = yawOf(quaternion);
      const dx = wx - position[0];
      const dy = wy - position[1];
      const slack = 4 / view.scale;
      return (
        Math.abs(dx * Math.cos(yaw) + dy * Math.sin(yaw)) < o.size[0] / 2 + slack &&
        Math.abs(dy * Math.cos(yaw) - dx * Math.sin(yaw)) < o.size[1] / 2 + slack
      );
    })
    .at(-1);
}
function down(e) {
  canvas.setPointerCapture(e.pointerId);
  const at = toWorld(e);
  if (object(model.selected) && !model.job) {
    const [hx, hy] = handleAt();
    if (Math.hypot(e.offsetX - hx, e.offsetY - hy) < 11) {
      return begin("turn", model.selected, at);
    }
  }
  const hit = under(at);
  if (hit && !model.job) {
    select(hit.object_id);
    return begin("move", hit.object_id, at);
  }
  if (!hit && !model.selected && model.box && inside(at)) {
    drag = { kind: "box", at, from: [...model.box.position] };
    return;
  }
  drag = { kind: "pan", from: [e.offsetX, e.offsetY], view: { ...view } };
}
function begin(kind, id, at) {
  const { position } = poseOf(object(id));
  drag = {
    kind,
    id,
    at,
    centre: position,
    angle: Math.atan2(at[1] - position[1], at[0] - position[0]),
  };
}
function move(e) {
  if (!drag) {
    return;
  }
  if (drag.kind === "pan") {
    view = {
      ...view,
      x: drag.view.x - (e.offsetX - drag.from[0]) / view.scale,
      y: drag.view.y + (e.offsetY - drag.from[1]) / view.scale,
    };
    return draw();
  }
  const [x, y] = toWorld(e);
  if (drag.kind === "box") {
    return moveBox(x - drag.at[0], y - drag.at[1]);
  }
  const angle = Math.atan2(y - drag.centre[1], x - drag.centre[0]) - drag.angle;
  model.draft =
    drag.kind === "move"
      ? { id: drag.id, x: x - drag.at[0], y: y - drag.at[1], angle: 0 }
      : { id: drag.id, x: 0, y: 0, angle: Math.atan2(Math.sin(angle), Math.cos(angle)) };
  emit("draft");
}
// The box lies along the axes of the world, and belongs to no object: nothing is committed.
const inside = (at) =>
  [0, 1].every((k) => Math.abs(at[k] - model.box.position[k]) < model.box.size[k] / 2);
function moveBox(dx, dy) {
  const place = (v) => Math.round(v * 10) / 10;
  model.box.position = [place(drag.from[0] + dx), place(drag.from[1] + dy), drag.from[2]];
  model.box.placed = true;
  emit("box");
}
async function up() {
  const was = drag;
  drag = null;
  if (was?.kind === "pan" || was?.kind === "box" || !model.draft) {
    return;
  }
  const { x, y } = model.draft;
  const round = (v) => Math.round(v * 1e4) / 1e4;
  if (was.kind === "move" && Math.hypot(x, y) * view.scale < 3) {
    model.draft = null;
    emit("draft");
    return;
  }
  Object.assign(model.draft, { x: round(x), y: round(y), angle: round(model.draft.angle) });
  await edit(draftOperations());
}
function zoom(e) {
  e.preventDefault();
  const [x, y] = toWorld(e);
  const factor = Math.exp(-e.deltaY * 0.0015);
  const scale = Math.min(120, Math.max(0.5, view.scale * factor));
  const k = view.scale / scale;
  view = { x: x + (view.x - x) * k, y: y + (view.y - y) * k, scale };
  draw();
}
