// The history: every revision, as Python and as curl.
import { WORKER } from "./api.js";
import { model, on } from "./model.js";
import { el } from "./dom.js";
import { notify, attempt } from "./messages.js";

export function startLog() {
  on("scenario", draw);
  draw();
}

function draw() {
  const entries = model.history.entries;
  const undone = undoneRevisions(entries);
  const edits = entries.filter((e) => e.kind === "edit");
  document.getElementById("log").replaceChildren(
    el(
      "div",
      { class: "actions" },
      el("button", {
        textContent: "Copy as Python",
        id: "copy-python",
        onclick: attempt(() => copy(asPython(inEffect()))),
      }),
      el("button", {
        textContent: "Copy as curl",
        id: "copy-curl",
        onclick: attempt(() => copy(asCurl(inEffect()))),
      }),
    ),
    ...(edits.length
      ? []
      : [
          el("p", {
            textContent:
              "Nothing was changed yet. Each change is kept here at once; nothing has to be saved.",
          }),
        ]),
    ...edits.reverse().map((entry) => card(entry, undone.has(entry.revision))),
  );
}
function undoneRevisions(entries) {
  const undone = new Set();
  for (const e of entries) {
    if (e.kind === "undo") {
      undone.add(e.target);
    } else if (e.kind === "redo") {
      undone.delete(e.target);
    }
  }
  return undone;
}
function inEffect() {
  const undone = undoneRevisions(model.history.entries);
  return model.history.entries
    .filter((e) => e.kind === "edit" && !undone.has(e.revision))
    .map((e) => e.operations);
}
function card(entry, undone) {
  const when = new Date(entry.created_at).toLocaleTimeString();
  return el(
    "div",
    { class: `entry${undone ? " undone" : ""}`, "data-revision": entry.revision },
    el(
      "header",
      {},
      el("strong", { textContent: `r${entry.revision}` }),
      el("span", { textContent: [...new Set(entry.operations.map((o) => o.op))].join(", ") }),
      el("span", { class: "grow" }),
      el("small", {
        textContent: `${undone ? "undone · " : ""}${entry.who || "somebody"} · ${when}`,
      }),
    ),
    ...entry.operations.map((o) => el("code", { textContent: JSON.stringify(withoutNulls(o)) })),
  );
}
export const withoutNulls = (operation) =>
  Object.fromEntries(Object.entries(operation).filter(([, v]) => v !== null));

export function asPython(batches) {
  const { scene, name } = model.scenario;
  const calls = batches.map((batch) => `    scenario.apply(${python(batch.map(withoutNulls))})`);
  return [
    "import real2sim",
    "",
    `with real2sim.connect(${python(WORKER)}) as sim:`,
    `    scenario = sim.scenarios.create(scene=${python(scene)}, name=${python(name)})`,
    ...calls,
    "",
  ].join("\n");
}
export function python(value) {
  if (value === null || value === undefined) {
    return "None";
  }
  if (typeof value === "boolean") {
    return value ? "True" : "False";
  }
  if (Array.isArray(value)) {
    return `[${value.map(python).join(", ")}]`;
  }
  if (typeof value === "object") {
    return `{${Object.entries(value)
      .map(([k, v]) => `${JSON.stringify(k)}: ${python(v)}`)
      .join(", ")}}`;
  }
  return JSON.stringify(value);
}
export function asCurl(batches) {
  const { scene, name } = model.scenario;
  const quoted = (body) => `'${JSON.stringify(body).replaceAll("'", "'\\''")}'`;
  const call = (path, body) =>
    `curl -sf -X POST ${path} -H 'Content-Type: application/json' \\\n     -d ${quoted(body)}`;
  const made = call(`${WORKER}/v1/scenarios`, { scene, name: `${name} (copy)` });
  const id = `ID=$(${made} | sed -E 's/.*"scenario_id": ?"([^"]+)".*/\\1/')`;
  const edits = batches.map((batch) =>
    call(`${WORKER}/v1/scenarios/$ID/operations`, { operations: batch.map(withoutNulls) }),
  );
  return [id, ...edits, ""].join("\n");
}
async function copy(text) {
  await navigator.clipboard.writeText(text);
  notify("Copied all changes in effect.");
}
