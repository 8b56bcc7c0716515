// Deletion with undo: the object is deleted when the message disappears or the page closes.
import { call, token, WORKER } from "./api.js";
import { attempt, notify } from "./messages.js";

const AFTER_MS = 8000;
const KEY = "real2sim-deleted";
const waiting = new Map();

// Ids being deleted; the worker may still list them after the page was left.
export const isInBin = (path) =>
  waiting.has(path) || JSON.parse(sessionStorage.getItem(KEY) ?? "[]").includes(path);

export function putInBin(path, name, changed) {
  const empty = attempt(async () => {
    waiting.delete(path);
    try {
      await call("DELETE", path);
    } finally {
      changed();
    }
  });
  const timer = setTimeout(empty, AFTER_MS);
  waiting.set(path, timer);
  changed();
  notify(`“${name}” is deleted`, "", {
    label: "Undo",
    after: AFTER_MS,
    act: () => {
      clearTimeout(timer);
      waiting.delete(path);
      changed();
    },
  });
}
addEventListener("pagehide", () => {
  const headers = token() ? { Authorization: `Bearer ${token()}` } : {};
  const gone = JSON.parse(sessionStorage.getItem(KEY) ?? "[]");
  for (const [path, timer] of waiting) {
    clearTimeout(timer);
    fetch(WORKER + path, { method: "DELETE", headers, keepalive: true });
    gone.push(path);
  }
  waiting.clear();
  sessionStorage.setItem(KEY, JSON.stringify(gone.slice(-50)));
});
