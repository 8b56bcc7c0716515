// Pointer input of the map: drag to move, the handle in front of a box to turn it, two fingers or
// scroll to zoom.
import { model, emit, object, poseOf, select, edit, draftOperations } from "./model.js";
import { yawOf } from "./poses.js";
import { handleAt } from "./map.js";
import { view, toWorld, zoomAt, panBy, shown } from "./map_view.js";

let canvas;
let redraw;
let drag = null;
const fingers = new Map();

export function startMapHands(given, draw) {
  canvas = given;
  redraw = draw;
  canvas.addEventListener("pointerdown", down);
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", letGo);
  canvas.addEventListener("wheel", wheel, { passive: false });
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
  fingers.set(e.pointerId, placeOf(e));
  if (fingers.size > 1) {
    return forget();
  }
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
  if (!hit && !model.selected && model.box && !model.live && inside(at)) {
    drag = { kind: "box", at, from: [...model.box.position] };
    return;
  }
  drag = { kind: "pan" };
}
const placeOf = ({ offsetX, offsetY }) => ({ offsetX, offsetY });
// A second finger cancels the action of the first.
function forget() {
  drag = null;
  if (model.draft) {
    model.draft = null;
    emit("draft");
  }
}
function letGo(e) {
  fingers.delete(e.pointerId);
  forget();
}
function pinch(e) {
  const [a, b] = [...fingers.values()];
  const before = spread(a, b);
  const old = fingers.get(e.pointerId);
  fingers.set(e.pointerId, placeOf(e));
  const [c, d] = [...fingers.values()];
  panBy((e.offsetX - old.offsetX) / 2, (e.offsetY - old.offsetY) / 2);
  const middle = { offsetX: (c.offsetX + d.offsetX) / 2, offsetY: (c.offsetY + d.offsetY) / 2 };
  zoomAt(middle, spread(c, d) / before);
  redraw();
}
const spread = (a, b) => Math.max(1, Math.hypot(a.offsetX - b.offsetX, a.offsetY - b.offsetY));

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
  if (fingers.size === 2 && fingers.has(e.pointerId)) {
    return pinch(e);
  }
  const old = fingers.get(e.pointerId);
  if (!drag || !old) {
    return null;
  }
  fingers.set(e.pointerId, placeOf(e));
  if (drag.kind === "pan") {
    panBy(e.offsetX - old.offsetX, e.offsetY - old.offsetY);
    return redraw();
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
  return null;
}
// The box is aligned with the world axes and belongs to no object, so nothing is committed.
const inside = (at) =>
  [0, 1].every((k) => Math.abs(at[k] - model.box.position[k]) < model.box.size[k] / 2);
function moveBox(dx, dy) {
  const place = (v) => Math.round(v * 10) / 10;
  model.box.position = [place(drag.from[0] + dx), place(drag.from[1] + dy), drag.from[2]];
  model.box.placed = true;
  emit("box");
}
async function up(e) {
  fingers.delete(e.pointerId);
  const was = drag;
  drag = null;
  if (!was || was.kind === "pan" || was.kind === "box" || !model.draft) {
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
function wheel(e) {
  e.preventDefault();
  zoomAt(e, Math.exp(-e.deltaY * 0.0015));
  redraw();
}
