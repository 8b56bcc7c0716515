// Settings of the scenario: time span, erased boxes of the background, colliders.
import { model, edit, emit } from "./model.js";
import { poseAt } from "./poses.js";
import { el, number, row } from "./dom.js";

export function scenePanel() {
  const { erased, colliders } = model.scenario;
  if (!model.box?.placed) {
    model.box = ahead();
  }
  return [
    el("fieldset", {}, el("legend", { textContent: "Time span" }), span()),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Box, dashed on the map" }),
      el("p", { textContent: "Drag it there, or type its place and size." }),
      row(
        "x y z [m]",
        ["x", "y", "z"].map((axis, k) => field(`box-${axis}`, model.box.position, k)),
      ),
      row(
        "l w h [m]",
        ["l", "w", "h"].map((axis, k) => field(`box-${axis}`, model.box.size, k)),
      ),
      el(
        "div",
        { class: "actions" },
        el("button", { textContent: "Erase background inside", id: "erase", onclick: erase }),
        el("button", {
          textContent: "Make it a wall",
          title: "A solid, invisible box for physics",
          id: "collide",
          onclick: collide,
        }),
        el("button", {
          textContent: "Make it a post",
          title: "A solid, invisible, upright cylinder for physics, as wide as the box",
          id: "post",
          onclick: post,
        }),
        el("button", {
          textContent: "Flat ground",
          title: "Physics uses a level plane at the bottom of the box",
          id: "plane",
          onclick: plane,
        }),
      ),
    ),
    ...listed(
      "Erased from the background",
      erased.map((r) => [r.region_id, place(r.pose.position)]),
    ),
    ...listed(
      "Colliders",
      colliders.map((c) => [
        c.collider_id,
        c.shape.position ? place(c.shape.position, c.shape.kind) : c.shape.kind,
      ]),
    ),
  ];
}
const tenth = (v) => Math.round(v * 10) / 10;
const place = ([x, y], kind = "box") => `${kind} at ${tenth(x)}, ${tenth(y)} m`;

function ahead() {
  const {
    position: [x, y, z],
    quaternion: [w, a, b, c],
  } = poseAt(model.scene.ego, model.t);
  const forward = [1 - 2 * (b * b + c * c), 2 * (a * b + w * c)];
  return {
    position: [x + 12 * forward[0], y + 12 * forward[1], z + 1].map(tenth),
    size: [4, 4, 2],
  };
}
function field(id, values, k) {
  return number(id, values[k], (v) => {
    if (v !== null) {
      values[k] = v;
    }
    model.box.placed = true;
    emit("draft");
  });
}
// While the box is dragged on the map.
export function refreshBox() {
  ["x", "y", "z"].forEach((axis, k) => {
    document.getElementById(`box-${axis}`).value = model.box.position[k];
  });
}
function span() {
  const { start_us: start, end_us: end } = model.scenario;
  const seconds = [start, end].map((t) => t / 1e6);
  const set = (k) => (v) => {
    seconds[k] = v;
    const [from, to] = seconds.map((s) => (s === null ? null : Math.round(s * 1e6)));
    return edit([{ op: "set_time", start_us: from, end_us: to }]);
  };
  return row("from, to [s]", [
    number("clock-start", seconds[0], set(0)),
    number("clock-end", seconds[1], set(1)),
  ]);
}
const copy = () => ({ position: [...model.box.position], size: [...model.box.size] });
const erase = () =>
  edit([{ op: "erase_region", pose: { position: copy().position }, size: copy().size }]);
const collide = () => edit([{ op: "add_collider", shape: { kind: "box", ...copy() } }]);
function post() {
  const {
    position,
    size: [length, width, height],
  } = copy();
  const radius = Math.min(length, width) / 2;
  return edit([{ op: "add_collider", shape: { kind: "cylinder", position, radius, height } }]);
}
function plane() {
  const {
    position: [x, y, z],
    size,
  } = copy();
  return edit([{ op: "add_collider", shape: { kind: "plane", point: [x, y, z - size[2] / 2] } }]);
}
function listed(title, things) {
  if (!things.length) {
    return [];
  }
  const rows = things.map(([id, where]) =>
    el(
      "div",
      { class: "thing" },
      el("span", { textContent: id }),
      el("small", { textContent: where }),
      el("button", {
        textContent: "Remove",
        class: "danger",
        "data-remove": id,
        onclick: () => edit([{ op: "delete", object_id: id }]),
      }),
    ),
  );
  return [el("fieldset", {}, el("legend", { textContent: title }), ...rows)];
}
