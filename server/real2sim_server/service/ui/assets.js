// The asset library: insert an asset, place it in front of the vehicle, or replace the selection.
import { model, on, edit, object } from "./model.js";
import { call, get, post, picture } from "./api.js";
import { poseAt, yawOf } from "./poses.js";
import { isInBin, putInBin } from "./bin.js";
import { el } from "./dom.js";
import { attempt, notify } from "./messages.js";

export function startAssets() {
  on("selection", attempt(draw));
  attempt(draw)();
}

async function draw() {
  const { assets: all } = await get("/v1/assets");
  const assets = all.filter((asset) => !isInBin(pathOf(asset.asset_id)));
  const subject = object(model.selected);
  const cut = el("button", {
    textContent: subject ? `Save ${subject.object_id} as asset` : "Save the selection as asset",
    disabled: !subject?.recorded_id,
    onclick: attempt(() => keep(subject)),
  });
  document.getElementById("assets").replaceChildren(
    el("div", { class: "actions" }, cut),
    ...(assets.length
      ? []
      : [
          el("p", {
            textContent:
              "The library is empty. Select a recorded object and save it, or upload a splat file with POST /v1/assets.",
          }),
        ]),
    el("div", { class: "cards" }, ...assets.map(card)),
  );
}
function card(asset) {
  const image = el("img", { alt: asset.asset_id });
  picture(`/v1/assets/${asset.asset_id}/thumbnail`, "image/png").then(
    (src) => (image.src = src),
    () => image.remove(),
  );
  return el(
    "div",
    { class: "card" },
    image,
    el("strong", { textContent: asset.asset_id }),
    el("small", {
      textContent: `${asset.category} · ${asset.size.map((s) => s.toFixed(1)).join(" × ")} m`,
    }),
    el("button", { textContent: "Insert", onclick: () => insert(asset) }),
    el("button", {
      textContent: "Replace",
      title: "Use this appearance for the selected object",
      disabled: !model.selected,
      onclick: () => edit([{ op: "replace", object_id: model.selected, asset_id: asset.asset_id }]),
    }),
    el("button", { textContent: "Delete", class: "danger", onclick: attempt(() => remove(asset)) }),
  );
}
function insert(asset) {
  const {
    position: [x, y, z],
    quaternion,
  } = poseAt(model.scene.ego, model.t);
  const yaw = yawOf(quaternion);
  const position = [x + 15 * Math.cos(yaw), y + 15 * Math.sin(yaw), z + asset.size[2] / 2];
  return edit([{ op: "insert", asset_id: asset.asset_id, pose: { position, quaternion } }]);
}
async function remove({ asset_id: id }) {
  await call("DELETE", `${pathOf(id)}?dry_run=true`);
  putInBin(pathOf(id), id, attempt(draw));
}
const pathOf = (id) => `/v1/assets/${id}`;
async function keep(subject) {
  const { assets } = await get("/v1/assets");
  const taken = new Set(assets.map((a) => a.asset_id));
  let asset_id = subject.recorded_id;
  for (let n = 2; taken.has(asset_id); n++) {
    asset_id = `${subject.recorded_id}_${n}`;
  }
  await post("/v1/assets", {
    scene: model.scenario.scene,
    object_id: subject.recorded_id,
    asset_id,
  });
  notify(`The library has ${asset_id} now`);
  await draw();
}
