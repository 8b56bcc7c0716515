// The open scenario, selection and time. All other modules listen to changes.
import { call, get, post, ApiError } from "./api.js";
import { editDrive, stateAfter } from "./drive_session.js";
import { poseAt, present, aboutZ, multiply } from "./poses.js";
import { notify } from "./messages.js";

export const model = {
  scene: null,
  lanes: null,
  scenario: null,
  history: null,
  camera: null,
  t: 0,
  selected: null,
  draft: null,
  job: null,
  playback: null,
  live: null,
  free: null,
  shows: "rgb",
  mosaic: false,
  space: false,
  remote: false, // in space, where the worker draws because this page is too slow
  when: "always",
  box: null,
  lidar: null,
  sweep: null,
};
const listeners = {};
export const on = (names, fn) => names.split(" ").forEach((n) => (listeners[n] ??= []).push(fn));
export const emit = (name) => (listeners[name] ?? []).forEach((fn) => fn());

const path = (rest = "") => `/v1/scenarios/${model.scenario.scenario_id}${rest}`;

export async function open(id) {
  model.scenario = await get(`/v1/scenarios/${id}`);
  model.scene = await get(`/v1/scenes/${model.scenario.scene}`);
  model.lanes = model.scene.lane_count
    ? await get(`/v1/scenes/${model.scenario.scene}/lanes?roads=false`)
    : null;
  model.history = await get(path("/operations"));
}

// Viewing needs no scenario: the recorded scene has a built-in one.
const RECORDED = "recorded.";
export const isRecorded = () => model.scenario.scenario_id.startsWith(RECORDED);
export async function look(scene) {
  const { content_hash: hash } = await get(`/v1/scenes/${encodeURIComponent(scene)}`);
  await open(`${RECORDED}${hash}`);
}
// Id of the user's scenario for changes and jobs, created on first use.
let making = null;
export async function own() {
  if (isRecorded()) {
    making ??= begin().finally(() => (making = null));
    await making;
  }
  return model.scenario.scenario_id;
}
async function begin() {
  const { scene } = model.scenario;
  const { scenario_id: id } = await post("/v1/scenarios", { scene, name: `${scene} edit` });
  await turnTo(id);
}
async function turnTo(id) {
  model.scenario = await get(`/v1/scenarios/${id}`);
  emit("begun");
  await refresh();
}
// A rejected change leaves nothing behind.
async function unmake(recorded) {
  const made = path();
  await turnTo(recorded);
  await call("DELETE", made);
}

export async function refresh() {
  [model.scenario, model.history] = await Promise.all([get(path()), get(path("/operations"))]);
  if (!object(model.selected)) {
    model.selected = null;
  }
  emit("scenario");
}

// The objects of the scenario, or of the world of a watched drive, including objects of a
// storyboard and those added while driving.
export function objects() {
  const { objects: all } = model.scenario;
  return model.live ? model.live.agents.map((a) => ({ ...find(all, a.object_id), ...a })) : all;
}
const find = (list, id) => list.find((o) => o.object_id === id);
export const object = (id) => find(objects(), id);
export const isHere = (subject) => !!model.live || present(subject, model.t);

// The shown pose: of a physics run while it plays, otherwise including the current drag.
export function poseOf(subject) {
  const run = model.playback?.tracks[subject.object_id];
  if (model.job && run) {
    return poseAt({ times_us: model.playback.times_us, ...run }, model.t);
  }
  const pose = editedPoseOf(subject);
  const draft = model.draft;
  if (draft?.id !== subject.object_id) {
    return pose;
  }
  const [x, y, z] = pose.position;
  return {
    position: [x + draft.x, y + draft.y, z],
    quaternion: multiply(aboutZ(draft.angle), pose.quaternion),
  };
}

// The pose of the ego: recorded, or in the shown drive.
export const egoPoseAt = (t) =>
  model.live?.ego ?? poseAt(model.playback?.ego ?? model.scene.ego, t);

// The pose that an edit starts from: in the watched drive, otherwise in the scenario.
export const editedPoseOf = (subject) =>
  find(model.live?.agents ?? [], subject.object_id) ?? poseAt(subject.trajectory, model.t);

export function draftOperations() {
  const draft = model.draft;
  if (!draft) {
    return [];
  }
  const list = [];
  const time_range = timeRange();
  if (draft.x || draft.y) {
    list.push({
      op: "translate",
      object_id: draft.id,
      x: draft.x,
      y: draft.y,
      snap: true,
      time_range,
    });
  }
  if (draft.angle) {
    list.push(rotation(draft.id, draft.angle, time_range));
  }
  return list;
}

// Rotate an object [rad] together with its path, at the current time; with a short time range, in
// place.
export function rotation(object_id, angle, time_range) {
  const passes = time_range && "start_us" in time_range && "end_us" in time_range;
  const about_us = passes ? undefined : model.t;
  return { op: "rotate", object_id, angle, time_range, about_us };
}

// The time range of edits, reset when another object is selected.
export function setWhen(when) {
  model.when = when;
  emit("when");
}
// The time range of an edit: fully applied at the current time, blended at its open end.
export function timeRange() {
  const blend_us = 500_000;
  const [start_us, end_us] = [model.t - blend_us, model.t + blend_us];
  if (model.when === "on") {
    return { start_us, blend_us };
  }
  if (model.when === "until") {
    return { end_us, blend_us };
  }
  if (model.when === "around") {
    return { start_us: start_us - blend_us, end_us: end_us + blend_us, blend_us };
  }
  return undefined;
}

// Apply operations, or a function that creates them from the state at their turn. While a drive is
// watched they edit that drive and not the scenario.
export async function edit(operations) {
  stopRun();
  const made = typeof operations === "function" ? operations : () => operations;
  return inTurn(() => {
    const list = made();
    if (!list.length) {
      return null;
    }
    return model.live ? changeDrive(list) : change("/operations", { operations: list });
  });
}
// Set a corner case of the gallery, optionally with other parameter values.
export const letHappen = (name, parameters) => {
  stopRun();
  return inTurn(() => change("/corner-case", { name, parameters }));
};
export const undo = () => inTurn(() => stepBack("/undo"));
export const redo = () => inTurn(() => stepBack("/redo"));
function stepBack(rest) {
  if (model.live) {
    return notify("Edits of a running drive cannot be undone.", "warm");
  }
  return !isRecorded() && change(rest);
}

// Changes of this page run in sequence, so that each uses the revision of the previous one.
let turn = Promise.resolve();
function inTurn(make) {
  turn = turn.then(make, make);
  return turn;
}

async function change(rest, body) {
  const recorded = isRecorded() && model.scenario.scenario_id;
  try {
    await own();
    const result = await post(path(rest), body, {
      "If-Match": model.scenario.etag,
      "Idempotency-Key": crypto.randomUUID?.() ?? `${Date.now()}-${Math.random()}`,
    });
    await refresh();
    return told(result);
  } catch (error) {
    const stale = error instanceof ApiError && error.status === 412;
    notify(
      stale
        ? "Somebody else has changed the scenario. Their changes are now shown; please repeat yours."
        : error.message,
      "bad",
    );
    await (recorded && !isRecorded() ? unmake(recorded) : refresh());
    return null;
  } finally {
    model.draft = null;
    emit("draft");
  }
}

async function changeDrive(operations) {
  const { session_id: session } = model.live;
  try {
    const result = await editDrive(session, operations);
    const state = await stateAfter(session, null);
    if (model.live?.session_id === session) {
      model.live = state;
      emit("drive-step");
    }
    return told(result);
  } catch (error) {
    notify(error.message, "bad");
    return null;
  } finally {
    model.draft = null;
    emit("draft");
  }
}
function told(result) {
  result.warnings.forEach((w) => notify(w.message, "warm"));
  if (result.created.length) {
    select(result.created[0]);
  }
  return result;
}

export function select(id) {
  if (id !== model.selected) {
    setWhen("always");
  }
  model.selected = id;
  emit("selection");
}
export function setTime(t) {
  const { start_us: start, end_us: end } = span();
  model.t = Math.round(Math.min(end, Math.max(start, t)));
  emit("time");
}
export const span = () =>
  model.job && model.playback
    ? { start_us: model.playback.times_us[0], end_us: model.playback.times_us.at(-1) }
    : model.scenario;
export function stopRun() {
  if (!model.job) {
    return;
  }
  model.job = model.playback = null;
  emit("run");
  setTime(model.t);
}
export const fork = (name) => post(path("/fork"), { name });
export async function exportFile() {
  return (await call("GET", path("/export"))).blob();
}
export async function startSimulation(body) {
  await own();
  return post(path("/simulate"), body);
}
