// Drive: a planner or a person drives the scenario, watched live; then the recording, at any time.
import { model, on, egoPoseAt, stopRun } from "./model.js";
import { el, row } from "./dom.js";
import { attempt } from "./messages.js";
import { ink } from "./theme.js";
import { addPictureLayer } from "./camera_view.js";
import { addLayer, follow } from "./map.js";
import { show } from "./physics.js";
import { drivesOf, isMine } from "./drive_session.js";
import { seat, start, startDriving, take, takeTheWheel, hold, end, press } from "./driving.js";
import { cornerCases, lookUp } from "./corner_cases.js";
import { button, eventList, figures, said } from "./drive_figures.js";
import { instant, isReplay, planInPicture, replay, replayed } from "./drive_replay.js";

const WHO = [
  ["idm", "idm: follows the lead vehicle"],
  ["follow_route", "follow_route: follows the route"],
  ["pid", "pid: follows the recording"],
  ["depth_sampling", "depth_sampling: plans with depth images"],
  ["hand", "me, with the arrow keys"],
  ["other", "an external planner"],
];
const PACES = [
  ["1", "real time"],
  ["2", "twice real time"],
  ["0.25", "a quarter"],
  ["", "maximum speed"],
];
const chosen = { who: "idm", pace: "1", onCollision: "terminate" };
const page = () => document.getElementById("drive");
let drives = [];
let happened = [];

export function startDrive() {
  startDriving();
  addLayer((pen, toScreen, { line }) => {
    const plan = model.live?.plan ?? (isReplay() ? model.playback.plans[instant()] : []);
    if (plan.length) {
      const ego = model.live?.ego.position ?? model.playback.ego.positions[instant()];
      line([ego, ...plan], ink().plan, 3);
    }
  });
  addPictureLayer(planInPicture);
  on("drive-toggle", () => attempt(hold)(!seat.held));
  on("drive", () => {
    happened = [];
    draw();
  });
  on("run scenario", draw);
  on("scenario", () => !page().hidden && listDrives());
  on("drive-step", live);
  on("drive-step", () => model.live && follow(model.live.ego.position));
  on("time", () => isReplay() && follow(egoPoseAt(model.t).position));
  on("time layout", () => isReplay() && replayed());
  draw();
}
// The last drive; a drive that runs in this tab is watched again after a reload.
export const listDrives = attempt(async () => {
  [drives] = await Promise.all([drivesOf(model.scenario.scenario_id), lookUp()]);
  const going = drives.find((job) => job.state === "running" && isMine(job.request.session_id));
  if (going && !seat) {
    attempt(take)(going, going.request.planner ?? "other");
  }
  draw();
});
async function leave() {
  stopRun();
  await listDrives();
}
function draw() {
  page().replaceChildren(
    ...(seat ? driving() : isReplay() ? replay(leave) : [...choice(), ...past()]),
  );
  if (seat) {
    live();
  } else if (isReplay()) {
    replayed();
  }
}

// --- before ----------------------------------------------------------------------------------

function choice() {
  return [
    el("p", {
      textContent: "Drive the recording vehicle through the current scenario.",
    }),
    ...cornerCases(draw),
    row("driver", [pick("who", WHO)]),
    row("pace", [pick("pace", PACES)]),
    row("after a crash", [
      pick("onCollision", [
        ["terminate", "stop the drive"],
        ["continue", "continue"],
      ]),
    ]),
    el(
      "div",
      { class: "actions" },
      button("drive-start", "Drive", () =>
        start({ ...chosen, pace: chosen.who === "hand" ? null : Number(chosen.pace) || null }),
      ),
    ),
  ];
}
function pick(name, options) {
  const select = el(
    "select",
    { id: `drive-${name}`, class: "wide", "aria-label": name },
    ...options.map(([value, label]) => new Option(label, value)),
  );
  select.value = chosen[name];
  select.onchange = () => (chosen[name] = select.value);
  return select;
}
function past() {
  const done = drives.filter((job) => job.state === "succeeded");
  if (!done.length) {
    return [];
  }
  return [
    el("h2", { class: "group-title", textContent: "Drives of this scenario" }),
    ...done.map((job) => {
      const { steps, reason } = job.result;
      const who = job.request.planner ?? "by hand";
      return el(
        "button",
        { class: "past", "data-drive": job.job_id, onclick: attempt(() => show(job.job_id)) },
        el("strong", { textContent: who }),
        el("small", {
          textContent: `${steps} steps · ${said(reason)} · ${new Date(job.created_at).toLocaleTimeString()}`,
        }),
      );
    }),
  ];
}

// --- live ------------------------------------------------------------------------------------

function driving() {
  const { held, who, session } = seat;
  return [
    el("p", { id: "drive-now", role: "status" }),
    el(
      "div",
      { class: "actions" },
      el("button", {
        id: "drive-hold",
        class: "primary",
        textContent: held ? "Go on" : "Pause",
        onclick: attempt(() => hold(!seat.held)),
      }),
      button("drive-step", "One step", () => hold(true, 1)),
      who === "hand"
        ? null
        : button("drive-wheel", "Take over", () => takeTheWheel(session, model.live.step)),
      button("drive-end", "End", end, "danger"),
    ),
    who === "hand" ? wheel() : null,
    who === "other"
      ? el("p", {
          textContent: `Let it drive session ${session}: real2sim drive --session ${session}`,
        })
      : null,
    el("dl", { id: "drive-figures", class: "figures" }),
    el("div", { id: "drive-events" }),
  ].filter(Boolean);
}
function live() {
  if (!seat || !document.getElementById("drive-now")) {
    return;
  }
  const state = model.live;
  const name = seat.who === "hand" ? "You drive" : `${seat.who} drives`;
  document.getElementById("drive-hold").textContent = seat.held ? "Go on" : "Pause";
  document.getElementById("drive-now").textContent = state
    ? `${name}${seat.held ? ", held" : ""} · step ${state.step} · ${state.ego.speed.toFixed(1)} m/s${
        state.planning_ms && seat.who !== "hand"
          ? ` · plans in ${state.planning_ms.toFixed(0)} ms`
          : ""
      }`
    : seat.stage || "Starting the session";
  if (!state) {
    return;
  }
  for (const event of state.events) {
    if (!happened.some((e) => e.t_us === event.t_us && e.type === event.type)) {
      happened.push(event);
    }
  }
  figures(Object.entries(state.metrics));
  document.getElementById("drive-events").replaceChildren(...eventList(happened, null));
}
function wheel() {
  const keys = [
    ["ArrowLeft", "←", "left"],
    ["ArrowUp", "↑", "faster"],
    ["ArrowDown", "↓", "brake"],
    ["ArrowRight", "→", "right"],
  ].map(([key, label, what]) => {
    const one = el("button", {
      textContent: label,
      "aria-label": what,
      title: `${what} (${label})`,
    });
    one.onpointerdown = () => press(key, true);
    one.onpointerup = one.onpointerleave = one.onpointercancel = () => press(key, false);
    return one;
  });
  return el("div", { class: "wheel" }, ...keys);
}
