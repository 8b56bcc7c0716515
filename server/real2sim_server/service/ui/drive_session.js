// A driven session: started, watched, paused, ended; manual driving sends plans.
import { call, get, post } from "./api.js";

const KEY = "real2sim-sessions";
const KEPT = 4;
const DT_US = 100_000;
const HORIZON = 20;
const WHEELBASE = 2.8;

// Session tokens stay in the tab, so that a reload can continue; the oldest ones are dropped.
const kept = () => JSON.parse(sessionStorage.getItem(KEY) ?? "[]");
function keep({ session_id: id, token }) {
  const all = [...kept(), { id, token }];
  all.slice(0, -KEPT).forEach((old) => remove(old.id).catch(() => null));
  sessionStorage.setItem(KEY, JSON.stringify(all.slice(-KEPT)));
}
export const isMine = (id) => kept().some((s) => s.id === id);
const headersOf = (id) => ({
  Authorization: `Bearer ${kept().find((s) => s.id === id)?.token ?? ""}`,
});

export async function begin(scenario, reset) {
  const query = new URLSearchParams({ scenario });
  const info = await post(`/v1/sessions?${query}`, { reset: { dt_us: DT_US, ...reset } });
  keep(info);
  return info.session_id;
}
const path = (id, rest) => `/v1/sessions/${id}/${rest}`;
export const drive = (id, planner) => post(path(id, "drive"), { planner }, headersOf(id));
export const setClock = (id, body) =>
  call("PUT", path(id, "clock"), { body, headers: headersOf(id) });
export async function fork(id, step) {
  const info = await post(path(id, `fork?step=${step}`), undefined, headersOf(id));
  keep(info);
  return info.session_id;
}
export const advance = (id, plan) => post(path(id, "step"), { n: 1, plan }, headersOf(id));
// Edits of the running world, before its next step.
export const editDrive = (id, operations) =>
  post(path(id, "operations"), { operations }, headersOf(id));
const remove = (id) => call("DELETE", `/v1/sessions/${id}`, { headers: headersOf(id) });
export const stateAfter = async (id, step) => {
  const after = step === null ? "" : `?after=${step}&wait_s=2`;
  return (await call("GET", path(id, `state${after}`), { headers: headersOf(id) })).json();
};
export async function pictureOf(id, camera, width) {
  const body = { sensors: [{ camera, width, codec: "jpeg" }] };
  const given = { body, headers: headersOf(id), accept: "image/jpeg" };
  return (await call("POST", path(id, "render"), given)).blob();
}
export const drivesOf = async (scenario) =>
  (await get(`/v1/jobs?subject=${encodeURIComponent(scenario)}`)).jobs.filter(
    (job) => job.kind === "drive",
  );

// Motion of a vehicle with constant acceleration [m/s^2] and steering [rad], in its own frame: a
// plan for its tracker.
export function planByHand({ t_us: t, ego }, acceleration, steering) {
  let [x, y, yaw, speed] = [0, 0, 0, ego.speed];
  const [times_us, poses] = [[], []];
  for (let k = 1; k <= HORIZON; k++) {
    speed = Math.max(0, speed + acceleration * 0.1);
    yaw += (speed * 0.1 * Math.tan(steering)) / WHEELBASE;
    x += speed * 0.1 * Math.cos(yaw);
    y += speed * 0.1 * Math.sin(yaw);
    times_us.push(t + k * DT_US);
    poses.push([x, y, yaw]);
  }
  return { kind: "trajectory", times_us, poses };
}
