// Keyboard shortcuts, and the page that lists them.
import { model, undo, redo, edit, select, rotation } from "./model.js";
import { toggle, step } from "./timeline.js";
import { toggleFree, toggleUncertainty } from "./camera_view.js";
import { toggleSpace } from "./space.js";
import { shift } from "./flight.js";
import { swap } from "./layout.js";
import { fit, centre } from "./map.js";
import { duplicate } from "./properties.js";
import { choose } from "./mosaic.js";
import { el } from "./dom.js";

const selected = (fn) => () => model.selected && fn(model.selected);
const nudge = (x, y) =>
  selected((id) => edit([{ op: "translate", object_id: id, x, y, frame: "object", snap: true }]));
const flying = (r, d, f) => () => model.free && shift(r, d, f);
const KEYS = [
  ["Space", "play, pause; holds a drive that is watched", " ", toggle],
  ["← →", "previous, next frame", "ArrowLeft", () => step(-1)],
  [null, "", "ArrowRight", () => step(1)],
  ["Ctrl Z", "undo", "ctrl+z", undo],
  ["Ctrl Y", "redo", "ctrl+y", redo],
  [null, "", "ctrl+shift+z", redo],
  ["Ctrl D", "duplicate the selection", "ctrl+d", selected(duplicate)],
  [
    "Del",
    "delete the selection",
    "Delete",
    selected((id) => edit([{ op: "delete", object_id: id }])),
  ],
  [
    "Shift + arrows",
    "move the selection by 0.25 m along its own axes",
    "shift+ArrowUp",
    nudge(0.25, 0),
  ],
  [null, "", "shift+ArrowDown", nudge(-0.25, 0)],
  [null, "", "shift+ArrowLeft", nudge(0, 0.25)],
  [null, "", "shift+ArrowRight", nudge(0, -0.25)],
  [
    "[ ]",
    "turn the selection by 5°",
    "[",
    selected((id) => edit([rotation(id, 0.0872665)])),
  ],
  [null, "", "]", selected((id) => edit([rotation(id, -0.0872665)]))],
  ["Arrows", "while driving: accelerate, brake, left, right", "", null],
  ["F", "free camera; drag to look, right-drag to move, scroll to go forward", "f", toggleFree],
  ["3", "3D view, rendered by this page", "3", toggleSpace],
  ["U", "uncertainty, if the scene has it", "u", toggleUncertainty],
  ["W A S D", "fly", "w", flying(0, 0, 0.5)],
  [null, "", "s", flying(0, 0, -0.5)],
  [null, "", "a", flying(-0.5, 0, 0)],
  [null, "", "d", flying(0.5, 0, 0)],
  ["M", "all cameras", "m", () => choose(model.mosaic ? model.camera : null)],
  ["X", "swap picture and map", "x", swap],
  ["0", "fit the map", "0", fit],
  ["C", "centre the map on the selection", "c", centre],
  ["Esc", "clear the selection", "Escape", () => select(null)],
  ["?", "this help", "?", () => help()],
];
const TYPED =
  "input:not([type=range], [type=checkbox], [type=radio], [type=button]), select, textarea, [contenteditable]";
const PRESSED = "button, a[href], summary, input[type=checkbox], input[type=radio], input[type=button]";
const MOVED = "[role=tab], [role=separator], input[type=radio], input[type=range]:not(#time)";
// Whether a key belongs to the focused control, for example typing or pressing it. Delete then
// never deletes the selected object. The time slider moves by frames.
function isNative({ target, key, ctrlKey, metaKey }) {
  if (target.closest(TYPED)) {
    return true;
  }
  if (ctrlKey || metaKey) {
    return false;
  }
  const presses = key === " " || key === "Enter" || key === "Delete";
  const moves = key.startsWith("Arrow") || key === "Home" || key === "End";
  return (presses && target.closest(`${PRESSED}, ${MOVED}`)) || (moves && target.closest(MOVED));
}
export function startShortcuts() {
  const rows = KEYS.filter(([label]) => label).flatMap(([label, what]) => [
    el("dt", {}, el("kbd", { textContent: label })),
    el("dd", { textContent: what }),
  ]);
  const dialog = document.getElementById("help");
  dialog.replaceChildren(el("h2", { textContent: "Keyboard" }), el("dl", {}, ...rows));
  dialog.onclick = () => dialog.close();
  document.getElementById("help-button").onclick = help;
  document.addEventListener("keydown", (e) => {
    if (isNative(e) || document.querySelector("dialog[open]")) {
      return;
    }
    const key = e.key.length === 1 ? e.key.toLowerCase() : e.key;
    const name = `${e.ctrlKey || e.metaKey ? "ctrl+" : ""}${e.shiftKey && (key.length > 1 || e.ctrlKey) ? "shift+" : ""}${key}`;
    const found = KEYS.find(([, , k]) => k === name);
    if (!found) {
      return;
    }
    e.preventDefault();
    found[3]();
  });
}
const help = () => document.getElementById("help").showModal();
