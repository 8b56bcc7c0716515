// The first page: scenarios that exist, and scenes to begin one on.
import { get, post, picture } from "./api.js";
import { el } from "./dom.js";
import { attempt } from "./messages.js";

export async function startPage() {
  document.getElementById("start").hidden = false;
  const [{ scenarios }, { scenes }] = await Promise.all([get("/v1/scenarios"), get("/v1/scenes")]);
  fill(
    "scenario-list",
    scenarios.reverse().map(scenarioCard),
    "No scenario yet. Begin one on a scene.",
  );
  fill(
    "scene-list",
    scenes.map(sceneCard),
    "The worker has no scene. Start it with --scenes FOLDER.",
  );
}
function fill(id, cards, otherwise) {
  document
    .getElementById(id)
    .replaceChildren(...(cards.length ? cards : [el("p", { textContent: otherwise })]));
}
const go = (id) => location.assign(`?scenario=${encodeURIComponent(id)}`);
const scenarioCard = (s) =>
  el(
    "button",
    { class: "card", onclick: () => go(s.scenario_id) },
    el("strong", { textContent: s.name || s.scenario_id }),
    el("small", {
      textContent: `on ${s.scene} · r${s.revision} · ${new Date(s.created_at).toLocaleString()}`,
    }),
  );
function sceneCard(s) {
  const begin = attempt(async () =>
    go((await post("/v1/scenarios", { scene: s.scene, name: `${s.scene} edit` })).scenario_id),
  );
  const image = el("img", { alt: "" });
  if (s.cameras.length && s.state !== "broken") {
    picture(`/v1/scenes/${s.scene}/render?camera=${s.cameras[0].name}&width=420`).then(
      (src) => (image.src = src),
      () => image.remove(),
    );
  }
  return el(
    "button",
    { class: "card", onclick: begin, disabled: !s.cameras.length, "data-scene": s.scene },
    image,
    el("strong", { textContent: s.scene }),
    el("small", {
      textContent:
        s.reason ??
        `${s.objects.length} objects · ${s.cameras.length} cameras · ${((s.end_us - s.start_us) / 1e6).toFixed(1)} s · ${(s.gaussians / 1000).toFixed(0)} k Gaussians`,
    }),
  );
}
