// The fleet page: the last report of each worker on the same store.
import { get } from "./api.js";
import { el } from "./dom.js";

const LOOK_MS = 2000;

const cell = (text) => el("td", { textContent: text });

function state(worker) {
  if (!worker.alive) {
    return "gone";
  }
  if (worker.draining) {
    return "draining";
  }
  return worker.ready ? "ready" : "not ready";
}

function scenes(worker) {
  const named = worker.scenes.map((scene) => {
    const driven = worker.scene_sessions[scene] ?? 0;
    return driven ? `${scene} (${driven})` : scene;
  });
  return named.join(", ") || "none";
}

function line(worker) {
  return el(
    "tr",
    { "data-worker": worker.worker_id },
    el("th", { scope: "row", textContent: worker.worker_id }),
    el("td", { class: `state ${state(worker).replace(" ", "-")}`, textContent: state(worker) }),
    cell(`${worker.sessions} of ${worker.max_sessions}`),
    cell(`${Math.round(worker.load * 100)} %`),
    cell(String(worker.queue)),
    cell(scenes(worker)),
    cell(worker.backend),
    cell(worker.version),
  );
}

async function look() {
  const summary = document.getElementById("summary");
  try {
    const { workers } = await get("/v1/fleet");
    const there = workers.filter((worker) => worker.alive);
    const open = there.reduce((sum, worker) => sum + worker.sessions, 0);
    summary.textContent = `Workers there: ${there.length} of ${workers.length}. Sessions: ${open}.`;
    document.getElementById("workers").replaceChildren(...workers.map(line));
  } catch (error) {
    summary.textContent = `${error.message} The page shows the last state.`;
  }
  setTimeout(look, LOOK_MS);
}

await look();
