// The current driver: a planner on the worker or the arrow keys; and the observed state.
import { model, object, own, on, emit, setTime, stopRun } from "./model.js";
import { events, get } from "./api.js";
import { notify } from "./messages.js";
import { showLive } from "./camera_view.js";
import { show } from "./physics.js";
import * as sessions from "./drive_session.js";

const TICK_MS = 100;
const NOT_YET_MS = 200;
const KEYS = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"];
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
const pressed = new Set();
export let seat = null;

// who: the name of a planner; "hand" for the keyboard; "other" for an external planner.
export async function start({ who, pace, onCollision }) {
  stopRun();
  const session = await sessions.begin(await own(), { on_collision: onCollision });
  if (pace) {
    await sessions.setClock(session, { state: "running", pace });
  }
  await sit(session, who);
}
// Continue manually from a step of a session, in a new session.
export async function takeTheWheel(session, step) {
  const forked = await sessions.fork(session, step);
  if (seat) {
    await end();
  }
  stopRun();
  await sit(forked, "hand");
}
async function sit(session, who) {
  const planner = who === "hand" || who === "other" ? null : who;
  await take(await sessions.drive(session, planner), who);
}
// Watch a running drive, and drive it if it is manual.
export async function take(job, who) {
  const { session_id: session } = job.request;
  seat = { session, job: job.job_id, who, held: false };
  emit("drive");
  const mine = seat;
  const watching = watch(mine);
  const driving = who === "hand" ? byHand(mine) : null;
  try {
    await Promise.race([ended(mine), failed(watching), failed(driving)]);
  } finally {
    if (seat === mine) {
      leave();
    }
  }
}
// A promise that settles only if the given one fails.
const failed = (promise) => new Promise((_, no) => promise?.catch(no));

export async function hold(held, steps = null) {
  seat.held = held;
  if (seat.who !== "hand") {
    const state = held ? { state: "held", ...(steps ? { steps } : {}) } : { state: "running" };
    await sessions.setClock(seat.session, state);
  } else if (steps) {
    seat.steps = steps;
  }
  emit("drive");
}
export const end = () => sessions.setClock(seat.session, { state: "ended" });

async function ended({ job }) {
  for await (const now of events(`/v1/jobs/${job}/events`)) {
    if (seat?.job === job) {
      seat.stage = now.stage;
      emit("drive-step");
    }
  }
  const { state, error, result } = await get(`/v1/jobs/${job}`);
  if (seat?.job !== job) {
    return;
  }
  if (state !== "succeeded") {
    throw new Error(error?.detail ?? `the drive is ${state}`);
  }
  if (result.error) {
    notify(`The planner failed: ${result.error}`, "bad");
  }
  leave();
  await show(job);
}
function leave() {
  seat = model.live = null;
  model.selected = object(model.selected) ? model.selected : null;
  pressed.clear();
  emit("drive");
  emit("run");
}
async function watch(mine) {
  for (let step = null; seat === mine;) {
    const state = await stateOf(mine, step);
    if (seat !== mine) {
      return;
    }
    if (state) {
      model.live = state;
      ({ step } = state);
      seat.held = mine.who === "hand" ? seat.held : state.held;
      setTime(state.t_us);
      emit("drive-step");
      if (!model.mosaic) {
        const seen = await sessions.pictureOf(mine.session, model.camera, width());
        showLive(seen, () => seat === mine && !model.mosaic);
      }
    }
    if (!state || state.terminated || state.truncated) {
      await pause(NOT_YET_MS);
    }
  }
}
async function stateOf({ session }, step) {
  try {
    return await sessions.stateAfter(session, step);
  } catch (error) {
    if (error.code === "NOT_RESET") {
      return null;
    }
    throw error;
  }
}
const width = () => Math.min(960, Math.max(160, document.getElementById("stage").clientWidth));

// --- by hand ---------------------------------------------------------------------------------

async function byHand(mine) {
  let now = await sessions.stateAfter(mine.session, null);
  let steering = 0;
  while (seat === mine && now) {
    const began = performance.now();
    if (!mine.held || mine.steps > 0) {
      mine.steps = mine.held ? mine.steps - 1 : 0;
      steering = turned(steering, now.ego.speed);
      now = await oneStep(mine, sessions.planByHand(now, accelerated(now.ego.speed), steering));
    }
    await pause(Math.max(0, TICK_MS - (performance.now() - began)));
  }
}
// Null once the episode is over.
async function oneStep({ session }, plan) {
  try {
    const state = await sessions.advance(session, plan);
    return state.terminated || state.truncated ? null : state;
  } catch (error) {
    if (error.code === "EPISODE_OVER") {
      return null;
    }
    throw error;
  }
}
const accelerated = (speed) =>
  pressed.has("ArrowDown") ? -5 : pressed.has("ArrowUp") ? 2.5 : speed > 0.5 ? -0.4 : 0;
// Move the wheel towards the pressed keys, less at high speed.
function turned(steering, speed) {
  const wanted = Number(pressed.has("ArrowLeft")) - Number(pressed.has("ArrowRight"));
  const most = 0.5 / (1 + speed / 6);
  return steering + Math.max(-0.12, Math.min(0.12, wanted * most - steering));
}
export function startDriving() {
  const handle = (e) => {
    if (seat?.who !== "hand" || !KEYS.includes(e.key) || e.target.matches("input, select")) {
      return;
    }
    e.preventDefault();
    e.stopPropagation();
    pressed[e.type === "keydown" ? "add" : "delete"](e.key);
  };
  document.addEventListener("keydown", handle, true);
  document.addEventListener("keyup", handle, true);
  addEventListener("blur", () => pressed.clear());
  on("scenario", () => model.live && emit("drive-step"));
}
// Buttons of the wheel, for touch.
export const press = (key, down) => pressed[down ? "add" : "delete"](key);
