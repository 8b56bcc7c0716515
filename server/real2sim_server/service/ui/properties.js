// The property panel: shows the selected object, turns each changed field into one operation.
import { model, on, object, poseOf, edit, select, emit, timeRange } from "./model.js";
import { yawOf, present } from "./poses.js";
import { el, number, row, tidy } from "./dom.js";
import { refreshBox, scenePanel } from "./scene_panel.js";

const MATERIALS = ["rigid", "metal", "foam", "rubber", "jelly", "sand", "snow"];
const page = () => document.getElementById("properties");

export function startProperties() {
  on("scenario selection run", draw);
  on("time draft", refreshPose);
  on("box", refreshBox);
  draw();
}
function draw() {
  const subject = object(model.selected);
  page().replaceChildren(...(subject ? panel(subject) : list()));
  refreshPose();
}
function list() {
  const rows = model.scenario.objects.map((o) =>
    el(
      "button",
      { onclick: () => select(o.object_id) },
      el("span", { textContent: o.object_id }),
      el("small", { textContent: present(o, model.t) ? o.category : `${o.category} · not now` }),
    ),
  );
  return [
    el("p", { textContent: "Click an object in the picture, on the map or here." }),
    el("div", { class: "object-list" }, ...rows),
    ...scenePanel(),
  ];
}
function panel(o) {
  const id = o.object_id;
  const physics = o.physics ?? {};
  const setPhysics = (name, value) =>
    edit([
      {
        op: "set_physics",
        object_id: id,
        mass: physics.mass,
        material: physics.material,
        friction: physics.friction,
        restitution: physics.restitution,
        [name]: value,
      },
    ]);
  const material = el(
    "select",
    { id: "material", onchange: (e) => setPhysics("material", e.target.value || null) },
    el("option", { value: "", textContent: "by category" }),
    ...MATERIALS.map((m) =>
      el("option", { value: m, textContent: m, selected: m === physics.material }),
    ),
  );
  material.className = "wide";
  const optional = (name, label, top) =>
    row(label, [
      number(`p-${name}`, physics[name], (v) => setPhysics(name, v), {
        min: 0,
        max: top,
        placeholder: "default",
        class: "wide",
      }),
    ]);
  return [
    el(
      "header",
      {},
      el("h2", { id: "selected-name", textContent: id }),
      el("small", { textContent: `${o.category} · ${o.gaussians.toLocaleString("en")} Gaussians` }),
    ),
    el(
      "div",
      { class: "actions" },
      action("Duplicate", "duplicate", () => duplicate(id)),
      action("To the ground", "snap", () => edit([{ op: "translate", object_id: id, snap: true }])),
      action("Delete", "delete", () => edit([{ op: "delete", object_id: id }]), "danger"),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Pose now" }),
      row(
        "x y z [m]",
        ["x", "y", "z"].map((axis, k) =>
          number(
            `pose-${axis}`,
            0,
            (v) =>
              v !== null &&
              edit([
                {
                  op: "translate",
                  object_id: id,
                  [axis]: v - poseOf(object(id)).position[k],
                  time_range: timeRange(),
                },
              ]),
          ),
        ),
      ),
      row("heading [°]", [
        number(
          "heading",
          0,
          (v) =>
            v !== null &&
            edit([
              {
                op: "rotate",
                object_id: id,
                angle: (v * Math.PI) / 180 - yawOf(poseOf(object(id)).quaternion),
                time_range: timeRange(),
              },
            ]),
          { class: "wide" },
        ),
      ]),
      row("holds", [when()]),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Timing" }),
      row("later by [s]", [
        number(
          "delay",
          0,
          (v) => v && edit([{ op: "retime", object_id: id, delay_us: Math.round(v * 1e6) }]),
          { class: "wide" },
        ),
      ]),
      row("speed [×]", [
        number(
          "retime-speed",
          1,
          (v) => v > 0 && v !== 1 && edit([{ op: "retime", object_id: id, speed: v }]),
          { class: "wide", min: 0.01, max: 100 },
        ),
      ]),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Size" }),
      row(
        "l w h [m]",
        ["x", "y", "z"].map((axis, k) =>
          number(
            `size-${axis}`,
            o.size[k],
            (v) => v > 0 && edit([{ op: "scale", object_id: id, [axis]: v / o.size[k] }]),
          ),
        ),
      ),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Physics" }),
      optional("mass", "mass [kg]", 1e7),
      row("material", [material]),
      optional("friction", "friction", 10),
      optional("restitution", "restitution", 1),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Velocity on entering the physics" }),
      velocity(o),
    ),
  ];
}
export const duplicate = (id) =>
  edit([
    { op: "duplicate", object_id: id, x: object(id).size[0] + 1.5, frame: "object", snap: true },
  ]);
const action = (label, name, onclick, kind = "") =>
  el("button", { textContent: label, onclick, class: kind, "data-action": name });
// For how long a move or turn holds, also one made with the mouse.
function when() {
  const choices = {
    always: "at all times",
    on: "from now on",
    until: "until now",
    around: "for 2 s around now",
  };
  const choose = (e) => {
    model.when = e.target.value;
    emit("draft");
  };
  return el(
    "select",
    { id: "when", class: "wide", onchange: choose, "aria-label": "when moves hold" },
    ...Object.entries(choices).map(([value, textContent]) =>
      el("option", { value, textContent, selected: value === model.when }),
    ),
  );
}
function velocity(o) {
  const given = o.velocity;
  const inputs = [0, 1, 2].map((k) =>
    number(`velocity-${"xyz"[k]}`, given?.linear?.[k], commit, { placeholder: "as is" }),
  );
  const frame = el(
    "select",
    { id: "velocity-frame", onchange: () => given && commit(), class: "wide" },
    ...["object", "world"].map((f) =>
      el("option", {
        value: f,
        textContent: f === "object" ? "x is forward" : "world axes",
        selected: f === given?.frame,
      }),
    ),
  );
  function commit() {
    const values = inputs.map((i) => i.value);
    const linear = values.every((v) => v === "") ? null : values.map(Number);
    return edit([
      {
        op: "set_velocity",
        object_id: o.object_id,
        linear,
        angular: given?.angular ?? null,
        frame: frame.value,
      },
    ]);
  }
  return el("div", {}, row("x y z [m/s]", inputs), row("axes", [frame]));
}
function refreshPose() {
  const subject = object(model.selected);
  const first = document.getElementById("pose-x");
  if (!subject || !first) {
    return;
  }
  const { position, quaternion } = poseOf(subject);
  ["x", "y", "z"].forEach((axis, k) => put(`pose-${axis}`, position[k], 2));
  put("heading", (yawOf(quaternion) * 180) / Math.PI, 2);
}
function put(id, value, digits) {
  const input = document.getElementById(id);
  if (document.activeElement !== input) {
    input.value = tidy(value, digits);
  }
}
