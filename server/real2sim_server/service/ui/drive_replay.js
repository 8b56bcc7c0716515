// A recorded drive at any time: plan, speed, scores, events.
import { model, setTime } from "./model.js";
import { get } from "./api.js";
import { el } from "./dom.js";
import { plot } from "./plot.js";
import { ink } from "./theme.js";
import { isMine } from "./drive_session.js";
import { takeTheWheel } from "./driving.js";
import { button, eventList, figures, said, seconds, terms } from "./drive_figures.js";

export const isReplay = () => model.playback?.kind === "drive";

export function replay(leave) {
  const { reason, scores, events, metrics } = model.playback;
  const last = Object.entries(metrics).map(([name, values]) => [name, values.at(-1)]);
  return [
    el("p", { id: "drive-over", textContent: `${seconds(lasts())} s driven; ${said(reason)}.` }),
    el(
      "div",
      { class: "actions" },
      button("drive-leave", "Back to the scenario", leave),
      button("drive-fork", "Take over here", goOn),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "Speed [m/s]" }),
      el("canvas", { id: "drive-speed", class: "plot" }),
    ),
    el(
      "fieldset",
      {},
      el("legend", { textContent: "At the current time" }),
      el("dl", { id: "drive-figures", class: "figures" }),
    ),
    ...eventList(events, setTime),
    el("h2", { class: "group-title", textContent: "Scores of the whole drive" }),
    el(
      "dl",
      { class: "figures" },
      ...terms(scores.length ? scores.map((s) => [s.name, s.value]) : last),
    ),
  ];
}
export function replayed() {
  const { times_us: times, speeds, metrics } = model.playback;
  if (!document.getElementById("drive-speed")) {
    return;
  }
  const k = instant();
  figures(Object.entries(metrics).map(([name, values]) => [name, values[k]]));
  plot(
    document.getElementById("drive-speed"),
    times.map((t) => (t - times[0]) / 1e6),
    [{ name: "driven", values: speeds }],
    (model.t - times[0]) / 1e6,
  );
}
async function goOn() {
  const job = await get(`/v1/jobs/${model.job}`);
  if (!isMine(job.request.session_id)) {
    throw new Error(
      "The session of this drive is closed or belongs to another tab. Start a new drive to take over.",
    );
  }
  await takeTheWheel(job.request.session_id, model.playback.steps[instant()]);
}
const lasts = () => model.playback.end_us - model.playback.start_us;
export const instant = () =>
  Math.max(
    0,
    model.playback.times_us.findLastIndex((t) => t <= model.t),
  );
// On the ground, and only for replayed drives, because live pictures come without a pose.
export function planInPicture(pen, toStage) {
  if (!isReplay()) {
    return;
  }
  const [, , z] = model.playback.ego.positions[instant()];
  const places = model.playback.plans[instant()].map(([x, y]) => toStage([x, y, z]));
  pen.strokeStyle = ink().plan;
  pen.lineWidth = 3;
  pen.beginPath();
  places.filter(Boolean).forEach((place) => pen.lineTo(...place));
  pen.stroke();
}
