// Pointer input of the 3D view: drag an object on the ground, its ring to turn it, elsewhere to
// orbit.
import { model, emit, object, poseOf, select, edit, draftOperations } from "./model.js";
import { rotate, present, project } from "./poses.js";

const RING_POINTS = 48;
const GRASP = 10; // px
const ORBIT = 0.006; // rad of a pixel
let drag = null;

export function startSpaceHands(canvas, view) {
  canvas.addEventListener("pointerdown", (e) => e.button === 0 && down(canvas, view(), e));
  canvas.addEventListener("pointermove", (e) => move(view(), e));
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", letGo);
}
// Points of the closed ring that turns an object, on the ground below it.
export function ringOf(subject) {
  const { position } = poseOf(subject);
  const radius = radiusOf(subject);
  const level = position[2] - subject.size[2] / 2;
  return [...Array(RING_POINTS + 1).keys()].map((k) => {
    const angle = (2 * Math.PI * k) / RING_POINTS;
    return [position[0] + radius * Math.cos(angle), position[1] + radius * Math.sin(angle), level];
  });
}
const radiusOf = ({ size }) => 0.6 * Math.hypot(size[0], size[1]) + 0.3;

// Ray of a pixel of the canvas: origin and direction in the world.
function rayOf({ K, T }, { offsetX, offsetY }) {
  const [x, y] = [(offsetX - K[2]) / K[0], (offsetY - K[5]) / K[4]];
  return {
    from: [T[3], T[7], T[11]],
    along: [0, 1, 2].map((i) => T[4 * i] * x + T[4 * i + 1] * y + T[4 * i + 2]),
  };
}
// Intersection of a ray with a horizontal plane; null if there is none within reach.
function onLevel({ from, along }, level) {
  const t = (level - from[2]) / along[2];
  return t > 0 && t < 500 ? [from[0] + t * along[0], from[1] + t * along[1]] : null;
}
// Distance along a ray to the box of an object; null if it misses.
function toBox({ from, along }, subject) {
  const { position, quaternion } = poseOf(subject);
  const [w, x, y, z] = quaternion;
  const own = (v) => rotate([w, -x, -y, -z], v);
  const start = own(from.map((v, i) => v - position[i]));
  const way = own(along);
  let [near, far] = [0, Infinity];
  for (let i = 0; i < 3; i++) {
    const half = subject.size[i] / 2;
    const [a, b] = [(-half - start[i]) / way[i], (half - start[i]) / way[i]];
    near = Math.max(near, Math.min(a, b));
    far = Math.min(far, Math.max(a, b));
  }
  return near <= far ? near : null;
}
function under(ray) {
  return model.scenario.objects
    .filter((o) => present(o, model.t))
    .map((o) => ({ o, t: toBox(ray, o) }))
    .filter(({ t }) => t !== null)
    .sort((a, b) => a.t - b.t)[0]?.o;
}
function onRing({ K, T }, { offsetX, offsetY }) {
  const subject = object(model.selected);
  return (
    !!subject &&
    present(subject, model.t) &&
    ringOf(subject).some((point) => {
      const pixel = project(point, T, K);
      return pixel && Math.hypot(pixel[0] - offsetX, pixel[1] - offsetY) < GRASP;
    })
  );
}
function down(canvas, view, e) {
  e.stopPropagation();
  canvas.setPointerCapture(e.pointerId);
  const ray = rayOf(view, e);
  const hit = under(ray);
  if (!model.job && onRing(view, e) && hit?.object_id !== model.selected) {
    return begin("turn", object(model.selected), ray);
  }
  if (hit) {
    select(hit.object_id);
    if (!model.job) {
      return begin("move", hit, ray);
    }
  }
  drag = { kind: "orbit", nothing: !hit, moved: 0, x: e.offsetX, y: e.offsetY };
  drag.pivot = pivotOf(view);
  return null;
}
function begin(kind, subject, ray) {
  const { position } = poseOf(subject);
  const level = position[2] - subject.size[2] / 2;
  const at = onLevel(ray, level);
  if (at) {
    const angle = Math.atan2(at[1] - position[1], at[0] - position[0]);
    drag = { kind, id: subject.object_id, level, at, centre: position, angle };
  }
}
// Centre of the orbit: the selection, otherwise the ground at the centre, otherwise a point ahead.
function pivotOf(view) {
  const subject = object(model.selected);
  if (subject && present(subject, model.t)) {
    return poseOf(subject).position;
  }
  const { T, width, height } = view;
  const middle = rayOf(view, { offsetX: width / 2, offsetY: height / 2 });
  const [, , ground] = model.scene.ego.positions[0];
  const at = onLevel(middle, ground);
  const near = at && Math.hypot(at[0] - T[3], at[1] - T[7]) < 60;
  return near ? [...at, ground] : middle.from.map((v, i) => v + 15 * middle.along[i]);
}
function move(view, e) {
  if (!drag) {
    return;
  }
  e.stopPropagation();
  if (drag.kind === "orbit") {
    orbit(e);
    return;
  }
  const at = onLevel(rayOf(view, e), drag.level);
  if (!at) {
    return;
  }
  const turned = Math.atan2(at[1] - drag.centre[1], at[0] - drag.centre[0]) - drag.angle;
  model.draft =
    drag.kind === "move"
      ? { id: drag.id, x: at[0] - drag.at[0], y: at[1] - drag.at[1], angle: 0 }
      : { id: drag.id, x: 0, y: 0, angle: Math.atan2(Math.sin(turned), Math.cos(turned)) };
  emit("draft");
}
function orbit({ offsetX, offsetY }) {
  const [dx, dy] = [offsetX - drag.x, offsetY - drag.y];
  Object.assign(drag, { x: offsetX, y: offsetY, moved: drag.moved + Math.abs(dx) + Math.abs(dy) });
  const T = model.free;
  const right = [T[0], T[4], 0];
  const length = Math.hypot(...right) || 1;
  const about = right.map((v) => v / length);
  const yaw = quaternionAbout([0, 0, 1], -dx * ORBIT);
  const pitch = quaternionAbout(about, -dy * ORBIT);
  const columns = (turned) => [0, 1, 2].map((k) => turned([T[k], T[4 + k], T[8 + k]]));
  const both = (v) => rotate(yaw, rotate(pitch, v));
  // No rotation over the top.
  const turned = columns(both)[1][2] < -0.02 ? both : (v) => rotate(yaw, v);
  const axes = columns(turned);
  const place = turned([0, 1, 2].map((i) => T[4 * i + 3] - drag.pivot[i])).map(
    (v, i) => v + drag.pivot[i],
  );
  const row = (i) => [axes[0][i], axes[1][i], axes[2][i], place[i]];
  model.free = [...row(0), ...row(1), ...row(2), 0, 0, 0, 1];
  emit("camera");
}
const quaternionAbout = ([x, y, z], angle) => {
  const s = Math.sin(angle / 2);
  return [Math.cos(angle / 2), x * s, y * s, z * s];
};
async function up(e) {
  const was = drag;
  drag = null;
  if (!was) {
    return;
  }
  e.stopPropagation();
  if (was.kind === "orbit") {
    if (was.nothing && was.moved < 4) {
      select(null);
    }
    return;
  }
  if (!model.draft) {
    return;
  }
  const round = (v) => Math.round(v * 1e4) / 1e4;
  const { x, y, angle } = model.draft;
  Object.assign(model.draft, { x: round(x), y: round(y), angle: round(angle) });
  await edit(draftOperations());
}
function letGo() {
  drag = null;
  if (model.draft) {
    model.draft = null;
    emit("draft");
  }
}
