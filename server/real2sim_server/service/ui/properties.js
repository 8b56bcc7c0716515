// The property panel: shows the selected object and turns each changed field into one operation.
import {
  model,
  on,
  object,
  objects,
  isHere,
  poseOf,
  editedPoseOf,
  edit,
  select,
  emit,
  timeRange,
  rotation,
  setWhen,
} from "./model.js";
import { yawOf } from "./poses.js";
import { el, number, row, tidy } from "./dom.js";
import { refreshBox, scenePanel } from "./scene_panel.js";

const MATERIALS = ["rigid", "metal", "foam", "rubber", "jelly", "sand", "snow"];
const page = () => document.getElementById("properties");

export function startProperties() {
  on("selection", draw);
  on("scenario", () => (object(drawn) ? refreshFields() : draw()));
  on("run time draft", refreshFields);
  on("drive drive-step", () => (drawnOf === ofNow() ? refreshFields() : draw()));
  on("box", refreshBox);
  on("when", drawWhen);
  draw();
}
// The panel persists while its object does, to keep focus and input.
let drawn = null;
let drawnOf = "";
const ofNow = () => {
  const ids = object(model.selected) ? [model.selected] : objects().map((o) => o.object_id);
  return [!!model.live, ...ids].join();
};
function draw() {
  drawn = model.selected;
  drawnOf = ofNow();
  const focused = page().contains(document.activeElement) ? document.activeElement.id : "";
  page().replaceChildren(...(object(drawn) ? panel(drawn) : list()));
  refreshFields();
  if (focused) {
    document.getElementById(focused)?.focus();
  }
}
function list() {
  const rows = objects().map((o) =>
    el(
      "button",
      { onclick: () => select(o.object_id) },
      el("span", { textContent: o.object_id }),
      el("small", { textContent: isHere(o) ? o.category : `${o.category} · not now` }),
    ),
  );
  return [
    el("p", { textContent: "Click an object in the picture, on the map or here." }),
    el("div", { class: "object-list" }, ...rows),
    ...(model.live ? [] : scenePanel()),
  ];
}
function panel(id) {
  const o = object(id);
  const gaussians = o.gaussians ? ` · ${o.gaussians.toLocaleString("en")} Gaussians` : "";
  return [
    el(
      "header",
      {},
      el("h2", { id: "selected-name", textContent: id }),
      el("small", { textContent: `${o.category}${gaussians}` }),
    ),
    el(
      "div",
      { class: "actions" },
      action("Duplicate", "duplicate", () => duplicate(id)),
      action("Put on ground", "snap", () => edit([{ op: "translate", object_id: id, snap: true }])),
      action("Delete", "delete", () => edit([{ op: "delete", object_id: id }]), "danger"),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Current pose" }),
      row(
        "x y z [m]",
        ["x", "y", "z"].map((axis, k) =>
          number(`pose-${axis}`, 0, (v) => v !== null && moveTo(id, axis, k, v)),
        ),
      ),
      row("heading [°]", [
        number("heading", 0, (v) => v !== null && turnTo(id, (v * Math.PI) / 180), {
          class: "wide",
        }),
      ]),
      row("holds", [when()]),
    ),
    ...(model.live
      ? [el("p", { textContent: "Edits change this drive only. The scenario stays as it is." })]
      : ofScenario(id)),
  ];
}
// Properties of a scenario's object beyond its pose.
function ofScenario(id) {
  const setPhysics = (name, value) =>
    edit(() => {
      const physics = object(id).physics ?? {};
      return [
        {
          op: "set_physics",
          object_id: id,
          mass: physics.mass,
          material: physics.material,
          friction: physics.friction,
          restitution: physics.restitution,
          [name]: value,
        },
      ];
    });
  const material = el(
    "select",
    {
      id: "material",
      "aria-label": "material",
      onchange: (e) => setPhysics("material", e.target.value || null),
    },
    el("option", { value: "", textContent: "by category" }),
    ...MATERIALS.map((m) => el("option", { value: m, textContent: m })),
  );
  material.className = "wide";
  const optional = (name, label, top) =>
    row(label, [
      number(`p-${name}`, null, (v) => setPhysics(name, v), {
        min: 0,
        max: top,
        placeholder: "default",
        class: "wide",
      }),
    ]);
  return [
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Timing" }),
      row("start [s]", [
        number("begins", 0, (v) => v !== null && beginAt(id, v), { class: "wide" }),
      ]),
      row("speed [× recorded]", [
        number("retime-speed", 1, (v) => v > 0 && driveAt(id, v), {
          class: "wide",
          min: 0.01,
          max: 100,
        }),
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
            object(id).size[k],
            (v) =>
              v > 0 && edit(() => [{ op: "scale", object_id: id, [axis]: v / object(id).size[k] }]),
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
      el("legend", { textContent: "Velocity at the start of physics" }),
      velocity(id),
    ),
  ];
}
// Input sets the object's own pose, even while a run shows another one.
function moveTo(id, axis, k, value) {
  const time_range = timeRange();
  return edit(() => {
    const here = editedPoseOf(object(id)).position[k];
    return [{ op: "translate", object_id: id, [axis]: value - here, time_range }];
  });
}
function turnTo(id, yaw) {
  const time_range = timeRange();
  return edit(() => {
    const angle = yaw - yawOf(editedPoseOf(object(id)).quaternion);
    return [rotation(id, angle, time_range)];
  });
}
const beginsAt = (o) => (o.start_us - model.scene.start_us) / 1e6;
const beginAt = (id, seconds) =>
  edit(() => {
    const delay_us = Math.round((seconds - beginsAt(object(id))) * 1e6);
    return delay_us === 0 ? [] : [{ op: "retime", object_id: id, delay_us }];
  });
// Ratio to the recorded speed; 1 without a recording.
function speedOf(o) {
  const recorded = model.scene.objects.find((r) => r.object_id === (o.recorded_id ?? o.object_id));
  const lasts = o.end_us - o.start_us;
  return recorded && lasts > 0 ? (recorded.end_us - recorded.start_us) / lasts : 1;
}
const driveAt = (id, times) =>
  edit(() => {
    const speed = times / speedOf(object(id));
    return Math.abs(speed - 1) < 1e-6 ? [] : [{ op: "retime", object_id: id, speed }];
  });
export const duplicate = (id) =>
  edit([
    { op: "duplicate", object_id: id, x: object(id).size[0] + 1.5, frame: "object", snap: true },
  ]);
const action = (label, name, onclick, kind = "") =>
  el("button", { textContent: label, onclick, class: kind, "data-action": name });
const WHEN = {
  always: "at all times",
  on: "from now on",
  until: "until now",
  around: "2 s around the current time",
};
// The time range of edits, including edits with the mouse; shown next to the map too if it is not
// the default.
function drawWhen() {
  const chip = document.getElementById("when-mode");
  chip.hidden = model.when === "always";
  chip.textContent = `Moves hold ${WHEN[model.when]} ✕`;
  chip.onclick = () => setWhen("always");
  const choice = document.getElementById("when");
  if (choice) {
    choice.value = model.when;
  }
}
function when() {
  const choose = (e) => {
    setWhen(e.target.value);
    emit("draft");
  };
  return el(
    "select",
    { id: "when", class: "wide", onchange: choose, "aria-label": "time range of edits" },
    ...Object.entries(WHEN).map(([value, textContent]) =>
      el("option", { value, textContent, selected: value === model.when }),
    ),
  );
}
function velocity(id) {
  const inputs = ["x", "y", "z"].map((axis) =>
    number(`velocity-${axis}`, null, commit, { placeholder: "as is" }),
  );
  const frame = el(
    "select",
    {
      id: "velocity-frame",
      "aria-label": "frame of the velocity",
      onchange: () => object(id).velocity && commit(),
      class: "wide",
    },
    ...["object", "world"].map((f) =>
      el("option", { value: f, textContent: f === "object" ? "x is forward" : "world axes" }),
    ),
  );
  function commit() {
    const values = inputs.map((i) => i.value);
    const linear = values.every((v) => v === "") ? null : values.map(Number);
    return edit(() => [
      {
        op: "set_velocity",
        object_id: id,
        linear,
        angular: object(id).velocity?.angular ?? null,
        frame: frame.value,
      },
    ]);
  }
  return el("div", {}, row("x y z [m/s]", inputs), row("axes", [frame]));
}
function refreshFields() {
  const o = object(drawn);
  if (!o || !document.getElementById("pose-x")) {
    return;
  }
  const { position, quaternion } = poseOf(o);
  ["x", "y", "z"].forEach((axis, k) => put(`pose-${axis}`, position[k], 2));
  put("heading", (yawOf(quaternion) * 180) / Math.PI, 2);
  if (!document.getElementById("material")) {
    return;
  }
  const physics = o.physics ?? {};
  ["x", "y", "z"].forEach((axis, k) => {
    put(`size-${axis}`, o.size[k]);
    put(`velocity-${axis}`, o.velocity?.linear?.[k]);
  });
  put("begins", beginsAt(o));
  put("retime-speed", speedOf(o));
  ["mass", "friction", "restitution"].forEach((name) => put(`p-${name}`, physics[name]));
  document.getElementById("material").value = physics.material ?? "";
  document.getElementById("velocity-frame").value = o.velocity?.frame ?? "object";
}
function put(id, value, digits = 3) {
  const input = document.getElementById(id);
  if (!input.dataset.typing) {
    input.value = tidy(value, digits);
  }
}
