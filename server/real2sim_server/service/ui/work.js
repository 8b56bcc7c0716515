// Jobs of this scenario or of all, with their results; runs, drives and videos open from here, also
// after a reload.
import { model, own } from "./model.js";
import { call, events, get, post, sentence } from "./api.js";
import { el } from "./dom.js";
import { attempt, notify } from "./messages.js";
import { show } from "./physics.js";
import { turnTo } from "./panels.js";

const AGAIN_MS = 1000;
const page = () => document.getElementById("work");
let jobs = [];
let all = false;
let timer = null;
let video = null;
let list = null;

// The controls stay in place when the list is drawn again, so that they keep the focus.
export function startWork() {
  video = el("button", {
    id: "make-video",
    class: "primary",
    title: "From the selected camera",
    onclick: attempt(film),
  });
  const others = el("input", { id: "work-of-all", type: "checkbox", checked: all });
  others.onchange = () => {
    all = others.checked;
    draw();
  };
  list = el("div", {});
  page().replaceChildren(
    el(
      "div",
      { class: "actions" },
      video,
      el("label", { class: "check" }, others, " work of all scenarios"),
    ),
    list,
  );
  draw();
}
export const listWork = attempt(async () => {
  clearTimeout(timer);
  ({ jobs } = await get("/v1/jobs?limit=200"));
  draw();
  if (jobs.some(active) && !page().hidden) {
    timer = setTimeout(listWork, AGAIN_MS);
  }
});
const active = (job) => job.state === "queued" || job.state === "running";

// Subject of a job: the scenario, or a run of it.
function ofScenario(job) {
  const { scenario_id: id } = model.scenario;
  const runs = jobs.filter((j) => j.subject === id).map((j) => j.job_id);
  return job.subject === id || runs.includes(job.request.simulation);
}
function draw() {
  const listed = jobs.filter((job) => all || ofScenario(job));
  const [running, done] = [listed.filter(active), listed.filter((job) => !active(job))];
  video.textContent = model.job ? "Film of this run" : "Film of the scenario";
  list.replaceChildren(
    ...(listed.length
      ? []
      : [
          el("p", {
            textContent:
              "No jobs yet. Physics runs, drives, films and data sets are listed here with their progress and results.",
          }),
        ]),
    ...group("Now", running),
    ...group("Done", done),
  );
}
const group = (title, some) =>
  some.length ? [el("h2", { class: "group-title", textContent: title }), ...some.map(entry)] : [];

function entry(job) {
  const name = nameOf(job);
  return el(
    "article",
    { class: `work ${job.state}`, "data-job": job.job_id },
    el(
      "header",
      {},
      el("strong", { textContent: name }),
      el("span", { class: "grow" }),
      el("small", { class: "state", textContent: stateOf(job) }),
    ),
    el("small", { textContent: detailsOf(job) }),
    active(job) ? el("progress", { max: 1, value: job.progress, ariaLabel: name }) : null,
    job.error ? el("p", { class: "refused", textContent: sentence(job.error.detail) }) : null,
    el("div", { class: "actions" }, ...actions(job)),
  );
}
function nameOf({ kind, request }) {
  if (kind === "drive") {
    return request.planner ? `Drive · ${request.planner}` : "Drive · by hand";
  }
  if (kind === "export") {
    return request.kind === "dataset" ? "Data set" : `Film · ${request.camera}`;
  }
  return { simulate: "Physics run", calibrate: "Calibration", load_scene: "Loading" }[kind] ?? kind;
}
function stateOf(job) {
  if (job.state === "queued") {
    return "queued";
  }
  if (job.state !== "running") {
    return { succeeded: "done", interrupted: "the worker stopped" }[job.state] ?? job.state;
  }
  const left = secondsLeft(job);
  return `${Math.round(job.progress * 100)} %${left === null ? "" : ` · ${duration(left)} left`}`;
}
// Estimated from the progress so far.
function secondsLeft({ started_at: started, progress }) {
  if (!started || progress < 0.03) {
    return null;
  }
  const gone = (Date.now() - Date.parse(started)) / 1000;
  return Math.max(0, (gone * (1 - progress)) / progress);
}
const duration = (s) => (s < 90 ? `${Math.ceil(s)} s` : `${Math.round(s / 60)} min`);

function detailsOf(job) {
  const parts = [new Date(job.created_at).toLocaleString(), job.who];
  if (all && !ofScenario(job)) {
    parts.push(`of ${job.subject}`);
  }
  if (active(job)) {
    parts.push(job.stage);
  } else if (job.kind === "drive" && job.result) {
    parts.push(`${job.result.steps} steps`, job.result.reason?.replaceAll("_", " "));
  } else if (job.files.length) {
    parts.push(`${(job.files.reduce((sum, f) => sum + f.bytes, 0) / 1e6).toFixed(1)} MB`);
  }
  return parts.filter(Boolean).join(" · ");
}
function actions(job) {
  const made = [];
  const shows = job.files.some((f) => f.name === "playback.json");
  if (shows && ofScenario(job)) {
    made.push(button("Show", () => open(job)));
  } else if (shows && job.request.scenario) {
    const query = new URLSearchParams({ scenario: job.request.scenario, run: job.job_id });
    made.push(el("a", { class: "button", href: `?${query}`, textContent: "Show" }));
  }
  for (const { name } of job.files.filter((f) => /\.(webm|tar|r2e)$/.test(f.name))) {
    const what = { webm: "Film", tar: "Archive", r2e: "Recording" }[name.split(".").at(-1)];
    made.push(button(what, () => download(job, name), `Download ${name}`));
  }
  made.push(
    active(job)
      ? button("Cancel", () => end(job))
      : button("Delete", () => end(job), "Delete with files", "danger"),
  );
  return made;
}
const button = (label, act, title = "", kind = "") =>
  el("button", { textContent: label, title, class: kind, onclick: attempt(act) });

async function open(job) {
  await show(job.job_id);
  turnTo(job.kind === "drive" ? "drive" : "physics");
}
async function end(job) {
  await call("DELETE", `/v1/jobs/${job.job_id}`);
  await listWork();
}
async function download(job, name) {
  const answer = await call("GET", `/v1/jobs/${job.job_id}/files/${name}`);
  const link = el("a", { download: `${job.job_id}.${name}` });
  link.href = URL.createObjectURL(await answer.blob());
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
async function film() {
  const of = model.job ? { simulation: model.job } : { scenario: await own() };
  const job = await post("/v1/exports", { ...of, camera: model.camera });
  await listWork();
  for await (const now of events(`/v1/jobs/${job.job_id}/events`)) {
    if (now.state === "succeeded") {
      notify("The film is ready, see Work.");
    }
  }
}
