// Scores, events and texts of a drive at the current time.
import { model } from "./model.js";
import { el } from "./dom.js";
import { attempt } from "./messages.js";

export const figures = (values) =>
  document.getElementById("drive-figures").replaceChildren(...terms(values));
export function terms(values) {
  return values.map(([name, value]) =>
    el(
      "div",
      {},
      el("dt", { textContent: name.replaceAll("_", " ") }),
      el("dd", { textContent: Number.isFinite(value) ? tidy(value) : "–" }),
    ),
  );
}
const tidy = (value) => String(Math.round(value * 1000) / 1000);
export function eventList(events, jump) {
  if (!events.length) {
    return [];
  }
  const began = model.playback?.start_us ?? model.scenario.start_us;
  return [
    el("h2", { class: "group-title", textContent: "Events" }),
    ...events.map((event) =>
      el(
        jump ? "button" : "div",
        { class: "past", ...(jump ? { onclick: () => jump(event.t_us) } : {}) },
        el("strong", { textContent: said(event.type) }),
        el("small", {
          textContent: [event.object_id, `${seconds(event.t_us - began)} s`]
            .filter(Boolean)
            .join(" · "),
        }),
      ),
    ),
  ];
}
export const seconds = (us) => (us / 1e6).toFixed(1);
const SAID = { horizon: "to the end", stopped: "stopped" };
export const said = (word) => SAID[word] ?? (word ?? "running").replaceAll("_", " ");
export const button = (id, label, act, kind = id === "drive-start" ? "primary" : "") =>
  el("button", { id, textContent: label, class: kind, onclick: attempt(act) });
