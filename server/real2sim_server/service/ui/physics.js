// Physics: start a job, watch its progress, play the result, show contacts and energies.
import { model, on, setTime, startSimulation, stopRun, emit } from "./model.js";
import { call, events, get, sentence } from "./api.js";
import { el } from "./dom.js";
import { attempt, notify } from "./messages.js";
import { plot } from "./plot.js";

const page = () => document.getElementById("physics");
let running = null;
let refused = "";
let duration = 2;

export function startPhysics() {
  on("scenario selection run", draw);
  // A hidden plot has no size.
  on("time layout", () => model.playback?.energies && chart());
  draw();
}
function draw() {
  const { start_us: start, end_us: end } = model.scenario;
  const seconds = el("input", {
    id: "duration",
    "aria-label": "for [s]",
    type: "number",
    min: 0.1,
    max: (end - start) / 1e6,
    step: "any",
    value: duration,
    class: "wide",
  });
  seconds.oninput = () => {
    duration = Number(seconds.value);
  };
  const moved = model.scenario.objects
    .filter((o) => o.velocity || o.physics)
    .map((o) => o.object_id);
  const parts = [
    el("p", {
      textContent: moved.length
        ? `Physics moves ${moved.join(", ")} and whatever they touch, from the time shown on.`
        : "Set a velocity or physical properties of an object first; physics moves it and whatever it touches.",
    }),
    el("div", { class: "row" }, el("label", { textContent: "for [s]" }), seconds),
    el(
      "div",
      { class: "actions" },
      el("button", {
        id: "run",
        class: "primary",
        textContent: "Run from here",
        disabled: !!running || !moved.length,
        onclick: attempt(() => run(duration)),
      }),
      running &&
        el("button", {
          textContent: "Cancel",
          onclick: attempt(() => call("DELETE", `/v1/jobs/${running.job_id}`)),
        }),
      model.job &&
        el("button", { id: "leave-run", textContent: "Back to the scenario", onclick: stopRun }),
    ),
  ];
  if (running) {
    parts.push(
      el("progress", { id: "progress", max: 1, value: running.progress }),
      el("small", { id: "stage-of-run", textContent: running.stage || running.state }),
    );
  }
  if (refused) {
    parts.push(el("p", { id: "refused", class: "refused", textContent: refused }));
  }
  if (model.playback?.energies) {
    parts.push(...results());
  }
  page().replaceChildren(...parts);
  if (model.playback?.energies) {
    chart();
  }
}
// Update parts of the page only, to keep focus and input.
function progress() {
  const bar = document.getElementById("progress");
  if (!bar) {
    return;
  }
  bar.value = running.progress;
  document.getElementById("stage-of-run").textContent = running.stage || running.state;
}
async function run(seconds) {
  stopRun();
  const end = model.scenario.end_us;
  const start = Math.min(model.t, end - 100_000);
  refused = "";
  running = await startSimulation({
    start_us: start,
    end_us: Math.min(end, Math.round(start + seconds * 1e6)),
  });
  try {
    draw();
    for await (running of events(`/v1/jobs/${running.job_id}/events`)) {
      progress();
    }
    const job = await get(`/v1/jobs/${running.job_id}`);
    if (job.state === "succeeded") {
      await show(job.job_id);
    } else if (job.state === "failed") {
      refused = sentence(job.error?.detail ?? "the run failed");
    } else {
      notify(`The run is ${job.state}.`);
    }
  } finally {
    running = null;
    draw();
  }
}
export async function show(job) {
  model.playback = await get(`/v1/jobs/${job}/files/playback.json`);
  model.job = job;
  emit("run");
  setTime(model.playback.times_us[0]);
}
// Changes by a contact beyond carrying a weight; older runs do not distinguish them.
const struck = (contact) => contact.impact_delta_v ?? contact.delta_v;
const CARRIED = 0.3;
function results() {
  const contacts = [...(model.playback.contacts ?? [])].sort((a, b) => struck(b) - struck(a));
  const rows = contacts.map((c) => {
    const what = struck(c) < CARRIED ? "carries it" : `${struck(c).toFixed(2)} m/s`;
    return el(
      "tr",
      {},
      ...[c.object_id, c.other, what, `${c.first_s.toFixed(2)} s`].map((t) =>
        el("td", { textContent: t }),
      ),
    );
  });
  return [
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Energy [kJ]" }),
      el("canvas", { class: "plot", id: "energy" }),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: `Contacts (${contacts.length})` }),
      el(
        "table",
        {},
        el("tr", {}, ...["object", "with", "Δv", "from"].map((t) => el("th", { textContent: t }))),
        ...rows,
      ),
    ),
  ];
}
function chart() {
  const { times_us: times, energies, energy_names: names } = model.playback;
  const seconds = times.map((t) => (t - times[0]) / 1e6);
  plot(
    document.getElementById("energy"),
    seconds,
    names.map((name, k) => ({ name, values: energies.map((row) => row[k] / 1000) })),
    (model.t - times[0]) / 1e6,
  );
}
