// The library: put an asset in front of the recording vehicle, in place of the selection, or add one.
import { model, on, edit, object } from "./model.js";
import { get, post, picture } from "./api.js";
import { poseAt, yawOf } from "./poses.js";
import { el } from "./dom.js";
import { attempt, say } from "./messages.js";

export function startAssets() { on("selection", attempt(draw)); attempt(draw)(); }

async function draw() {
  const { assets } = await get("/v1/assets");
  const subject = object(model.selected);
  const cut = el("button", { textContent: subject ? `Keep ${subject.object_id} as asset` : "Keep the selection as asset", disabled: !subject?.recorded_id, onclick: attempt(() => keep(subject)) });
  document.getElementById("assets").replaceChildren(el("div", { class: "actions" }, cut),
    ...(assets.length ? [] : [el("p", { textContent: "The library is empty. Select a recorded object and keep it, or upload a splat file with POST /v1/assets." })]),
    el("div", { class: "cards" }, ...assets.map(card)));
}
function card(asset) {
  const image = el("img", { alt: asset.asset_id });
  picture(`/v1/assets/${asset.asset_id}/thumbnail`, "image/png").then((src) => (image.src = src), () => image.remove());
  return el("div", { class: "card" }, image, el("strong", { textContent: asset.asset_id }),
    el("small", { textContent: `${asset.category} · ${asset.size.map((s) => s.toFixed(1)).join(" × ")} m` }),
    el("button", { textContent: "Insert", onclick: () => insert(asset) }),
    el("button", { textContent: "Replace", title: "Give the selected object this look", disabled: !model.selected, onclick: () => edit([{ op: "replace", object_id: model.selected, asset_id: asset.asset_id }]) }));
}
function insert(asset) {
  const { position: [x, y, z], quaternion } = poseAt(model.scene.ego, model.t), yaw = yawOf(quaternion);
  const position = [x + 15 * Math.cos(yaw), y + 15 * Math.sin(yaw), z + asset.size[2] / 2];
  return edit([{ op: "insert", asset_id: asset.asset_id, pose: { position, quaternion } }]);
}
async function keep(subject) {
  await post("/v1/assets", { scene: model.scenario.scene, object_id: subject.recorded_id });
  say(`${subject.recorded_id} is in the library now`);
  await draw();
}
