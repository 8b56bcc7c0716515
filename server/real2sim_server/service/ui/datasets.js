// Data sets of the scenario: exported by jobs; labels over pictures, and statistics by class.
import { model, own } from "./model.js";
import { call, events, get, picture, post, sentence } from "./api.js";
import { el, number, row } from "./dom.js";
import { attempt, notify } from "./messages.js";

const FORMATS = [
  "nuscenes",
  "kitti",
  "kitti_raw",
  "coco",
  "argoverse2",
  "waymo",
  "ncore",
  "webdataset",
  "mcap",
  "labels",
  "pictures",
];
const asked = { formats: new Set(["nuscenes"]), seconds: 0.5, width: null };
const page = () => document.getElementById("datasets");
let running = null;
let told = "";
let finished = [];
let shown = null;

export function startDatasets() {
  draw();
}
const isDataset = (job) => job.kind === "export" && job.request.kind === "dataset";
export const listDatasets = attempt(list);
async function list() {
  const subject = encodeURIComponent(model.scenario.scenario_id);
  const { jobs } = await get(`/v1/jobs?subject=${subject}`);
  finished = jobs.filter((j) => isDataset(j) && j.state === "succeeded" && j.files.length);
  draw();
}
function draw() {
  const parts = [...form()];
  if (running) {
    parts.push(
      el("progress", { id: "dataset-progress", max: 1, value: running.progress }),
      el("small", { id: "dataset-stage", textContent: running.stage || running.state }),
    );
  }
  if (told) {
    parts.push(el("p", { id: "dataset-told", textContent: told }));
  }
  parts.push(...finished.map(entry));
  page().replaceChildren(...parts);
}
function form() {
  const boxes = FORMATS.map((name) => {
    const box = el("input", { type: "checkbox", checked: asked.formats.has(name) });
    box.onchange = () => {
      asked.formats[box.checked ? "add" : "delete"](name);
      draw();
    };
    return el("label", { class: "format" }, box, ` ${name}`);
  });
  const period = number("dataset-period", asked.seconds, (v) => (asked.seconds = v ?? 0.5), {
    min: 0.001,
    max: 60,
  });
  const width = number("dataset-width", asked.width, (v) => (asked.width = v), {
    min: 16,
    max: 8192,
    placeholder: "recorded",
  });
  const idle = !running && asked.formats.size > 0;
  return [
    el("p", {
      textContent:
        "Images of all cameras with boxes, masks, depth, flow, points and tracks, for the current scenario.",
    }),
    el("div", { class: "formats" }, ...boxes),
    row("every [s]", [period]),
    row("width [px]", [width]),
    el(
      "div",
      { class: "actions" },
      el("button", {
        id: "make-dataset",
        class: "primary",
        textContent: "Export data set",
        disabled: !idle,
        onclick: attempt(() => make(false)),
      }),
      el("button", {
        id: "estimate-dataset",
        textContent: "Estimate",
        disabled: !idle,
        onclick: attempt(() => make(true)),
      }),
      running &&
        el("button", {
          textContent: "Cancel",
          onclick: attempt(() => call("DELETE", `/v1/jobs/${running.job_id}`)),
        }),
    ),
  ];
}
async function make(dryRun) {
  told = "";
  running = await post("/v1/exports", {
    kind: "dataset",
    scenario: await own(),
    formats: [...asked.formats],
    period_us: Math.round(asked.seconds * 1e6),
    dry_run: dryRun,
    ...(asked.width ? { width: asked.width } : {}),
  });
  try {
    draw();
    for await (running of events(`/v1/jobs/${running.job_id}/events`)) {
      progress();
    }
    ended(await get(`/v1/jobs/${running.job_id}`), dryRun);
  } finally {
    running = null;
    await list();
  }
}
function progress() {
  const bar = document.getElementById("dataset-progress");
  if (bar) {
    bar.value = running.progress;
    document.getElementById("dataset-stage").textContent = running.stage || running.state;
  }
}
function ended(job, dryRun) {
  if (job.state === "failed") {
    told = sentence(job.error?.detail ?? "the data set failed");
  } else if (job.state !== "succeeded") {
    notify(`The data set is ${job.state}.`);
  } else if (dryRun) {
    const { frames, images, bytes, minutes } = job.result;
    const size = (bytes / 1e6).toFixed(0);
    told = `${frames} frames, ${images} images, about ${size} MB and ${minutes.toFixed(1)} minutes.`;
  } else {
    shown = job.job_id;
  }
}
function entry(job) {
  const { formats, frames } = job.result;
  const made = new Date(job.created_at).toLocaleString();
  const head = el("summary", { textContent: `${formats.join(", ")} · ${frames} frames · ${made}` });
  const body = el("div", { class: "dataset" });
  const box = el("details", { class: "dataset-entry", open: job.job_id === shown }, head, body);
  const fill = attempt(async () => {
    if (box.open && !body.children.length) {
      body.replaceChildren(...contents(job));
    }
  });
  box.ontoggle = fill;
  fill();
  return box;
}
function contents(job) {
  const sheets = job.files.filter((f) => f.name.startsWith("preview_")).map((f) => sheet(job, f));
  const archive = job.files.find((f) => f.name === "dataset.tar");
  const size = (archive.bytes / 1e6).toFixed(1);
  return [
    el("div", { class: "sheets" }, ...sheets),
    ...statistics(job.result.statistics),
    el("small", { textContent: `Licence of the source: ${job.result.licence}` }),
    el(
      "div",
      { class: "actions" },
      el("button", {
        textContent: `Download (${size} MB)`,
        onclick: attempt(() => download(job)),
      }),
      el("button", {
        textContent: "Delete",
        class: "danger",
        onclick: attempt(async () => {
          await call("DELETE", `/v1/jobs/${job.job_id}`);
          await list();
        }),
      }),
    ),
  ];
}
// Boxes, instances, classes and flow of one frame; a click enlarges it.
function sheet(job, file) {
  const image = el("img", { alt: "Labels over a picture", title: "Show it large" });
  picture(`/v1/jobs/${job.job_id}/files/${file.name}`).then(
    (src) => (image.src = src),
    () => image.remove(),
  );
  image.onclick = () => {
    const dialog = document.getElementById("sheet");
    dialog.replaceChildren(el("img", { src: image.src, alt: "Labels over a picture" }));
    dialog.onclick = () => dialog.close();
    dialog.showModal();
  };
  return image;
}
function statistics(found) {
  const classes = Object.keys(found.boxes);
  const rows = classes.map((name) => [name, found.boxes[name], found.tracks[name]]);
  return [
    table("Boxes", ["class", "boxes", "tracks"], rows),
    shares("By distance", classes, found.boxes_by_distance),
    shares("Visible in images of", classes, found.boxes_in_images_by_visibility),
  ];
}
function table(title, heads, rows) {
  const lines = rows.map((cells) =>
    el("tr", {}, ...cells.map((c) => el("td", { textContent: String(c ?? 0) }))),
  );
  const head = el("tr", {}, ...heads.map((h) => el("th", { textContent: h })));
  return el("fieldset", {}, el("legend", { textContent: title }), el("table", {}, head, ...lines));
}
// One bar per class, divided by the shares of its boxes.
function shares(title, classes, counts) {
  const lines = classes
    .filter((name) => counts[name])
    .map((name) => {
      const all = Object.values(counts[name]).reduce((a, b) => a + b, 0);
      const parts = Object.entries(counts[name]).map(([key, count], k) => {
        const part = el("span", { class: `share-${k}`, title: `${key}: ${count}` });
        part.style.flexGrow = count / all;
        part.textContent = count / all > 0.2 ? key.replace(" and more", "+") : "";
        return part;
      });
      return el(
        "div",
        { class: "row" },
        el("label", { textContent: name }),
        el("div", { class: "shares" }, ...parts),
      );
    });
  return el("fieldset", {}, el("legend", { textContent: title }), ...lines);
}
async function download(job) {
  const answer = await call("GET", `/v1/jobs/${job.job_id}/files/dataset.tar`);
  const link = el("a", { download: `${model.scenario.scenario_id}.tar` });
  link.href = URL.createObjectURL(await answer.blob());
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
