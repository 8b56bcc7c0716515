// The first page: existing scenarios, and scenes to create one for.
import { call, get, picture, post } from "./api.js";
import { isInBin, putInBin } from "./bin.js";
import { el } from "./dom.js";
import { attempt } from "./messages.js";

export async function startPage() {
  document.getElementById("start").hidden = false;
  await Promise.all([listScenes(), listScenarios()]);
}
async function listScenes() {
  const { scenes } = await get("/v1/scenes");
  fill(
    "scene-list",
    scenes.map(sceneCard),
    "The worker has no scene. real2sim reconstruct makes one of your drive; start the worker with --scenes FOLDER.",
    el("button", { id: "add-demo", textContent: "Add the demo street", onclick: addDemo }),
  );
}
async function addDemo({ target }) {
  target.disabled = true;
  await attempt(() => post("/v1/scenes", { demo: true }))();
  await attempt(listScenes)();
}
async function listScenarios() {
  const { scenarios } = await get("/v1/scenarios");
  fill(
    "scenario-list",
    scenarios
      .reverse()
      .filter((s) => !isInBin(pathOf(s)))
      .map(scenarioCard),
    "No scenario yet. The first edit of a scene creates one.",
  );
}
function fill(id, cards, otherwise, ...more) {
  document
    .getElementById(id)
    .replaceChildren(...(cards.length ? cards : [el("p", { textContent: otherwise }), ...more]));
}
const pathOf = (s) => `/v1/scenarios/${s.scenario_id}`;
const nameOf = (s) => s.name || s.scenario_id;
const scenarioCard = (s) =>
  el(
    "div",
    { class: "card", "data-scenario": s.scenario_id },
    el(
      "a",
      { class: "open", href: `?scenario=${encodeURIComponent(s.scenario_id)}` },
      el("strong", { textContent: nameOf(s) }),
      el("small", {
        textContent: `on ${s.scene} · r${s.revision} · ${new Date(s.created_at).toLocaleString()}`,
      }),
    ),
    el(
      "div",
      { class: "group" },
      el("button", {
        textContent: "Rename",
        ariaLabel: `Rename ${nameOf(s)}`,
        onclick: attempt(() => rename(s)),
      }),
      el("button", {
        textContent: "Delete",
        class: "danger",
        ariaLabel: `Delete ${nameOf(s)}`,
        onclick: () => putInBin(pathOf(s), nameOf(s), attempt(listScenarios)),
      }),
    ),
  );
async function rename(s) {
  const name = prompt("Name", s.name)?.trim();
  if (name) {
    await call("PATCH", pathOf(s), { body: { name } });
    await listScenarios();
  }
}
function sceneCard(s) {
  const look = () => location.assign(`?scene=${encodeURIComponent(s.scene)}`);
  const image = el("img", { alt: "" });
  if (s.cameras.length && s.state !== "broken") {
    picture(`/v1/scenes/${s.scene}/render?camera=${s.cameras[0].name}&width=420`).then(
      (src) => (image.src = src),
      () => image.remove(),
    );
  }
  return el(
    "button",
    { class: "card", onclick: look, disabled: !s.cameras.length, "data-scene": s.scene },
    image,
    el("strong", { textContent: s.scene }),
    el("small", {
      textContent:
        s.reason ??
        `${s.objects.length} objects · ${s.cameras.length} cameras · ${((s.end_us - s.start_us) / 1e6).toFixed(1)} s · ${(s.gaussians / 1000).toFixed(0)} k Gaussians`,
    }),
  );
}
