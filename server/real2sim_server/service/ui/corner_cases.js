// Corner cases of the gallery, each with a picture. Choosing one is an edit that can be undone.
import { model, edit, letHappen, isRecorded } from "./model.js";
import { get, picture } from "./api.js";
import { el, number, row } from "./dom.js";
import { attempt } from "./messages.js";

const SVG = "image/svg+xml";
let cases = [];
let written = null;
let chosen = null;
let values = {};
let seen = null;

// The gallery, constant while the page is open, and the current storyboard.
export async function lookUp() {
  if (!cases.length) {
    ({ cases } = await get("/v1/gallery"));
  }
  const path = `/v1/scenarios/${encodeURIComponent(model.scenario.scenario_id)}/storyboard`;
  written = isRecorded() ? null : await get(path);
}
// Rows of a form; `draw` redraws it.
export function cornerCases(draw) {
  const select = el(
    "select",
    { id: "corner-case", class: "wide", "aria-label": "corner case" },
    new Option("Select a corner case", ""),
    ...families().map(([family, members]) =>
      el(
        "optgroup",
        { label: family },
        ...members.map((c) => new Option(c.title.split(":")[0], c.name)),
      ),
    ),
  );
  select.value = chosen?.name ?? "";
  select.onchange = attempt(async () => {
    chosen = cases.find((c) => c.name === select.value) ?? null;
    values = {};
    await look();
    draw();
  });
  const now = written ? `Now: ${written.name || "a storyboard of your own"}.` : "";
  return [
    row("corner case", [select]),
    ...(chosen ? choice() : []),
    ...(now ? [el("small", { id: "corner-case-now", textContent: now }), nothing()] : []),
  ];
}
function families() {
  const found = new Map();
  cases.forEach((c) => found.set(c.family, [...(found.get(c.family) ?? []), c]));
  return [...found];
}
async function look() {
  URL.revokeObjectURL(seen);
  seen = chosen && (await picture(chosen.picture, SVG));
}
function choice() {
  const fields = Object.entries(chosen.parameters).map(([name, value]) =>
    row(name, [number(`case-${name}`, values[name] ?? value, (v) => (values[name] = v ?? value))]),
  );
  return [
    el("img", { id: "corner-case-picture", src: seen, alt: chosen.title, class: "case" }),
    el("p", { textContent: `${chosen.title}.` }),
    ...fields,
    act("take-case", "Let it happen", () => letHappen(chosen.name, values)),
  ];
}
const nothing = () =>
  act("drop-case", "Remove corner case", () => edit([{ op: "set_storyboard", storyboard: null }]));
const act = (id, label, change) =>
  el(
    "div",
    { class: "actions" },
    el("button", {
      id,
      textContent: label,
      onclick: attempt(change),
    }),
  );
