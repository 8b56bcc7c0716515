// Panel sizes: set by dragging or arrow keys, and restored later.
import { emit } from "./model.js";

const KEY = "real2sim-layout";
const LIMITS = { side: [240, 900], map: [120, 900] };
const STEP = 24;
const $ = (id) => document.getElementById(id);
let kept = { side: null, map: null, swapped: false };

export function startLayout() {
  kept = { ...kept, ...read() };
  splitter($("split-side"), "side", (e) => document.body.clientWidth - e.clientX - railWidth());
  splitter($("split-map"), "map", (e) => $("timeline").getBoundingClientRect().top - e.clientY);
  $("swap").onclick = swap;
  apply();
}
// Swap the map and the picture.
export function swap() {
  kept.swapped = !kept.swapped;
  save();
}
function read() {
  try {
    return JSON.parse(localStorage.getItem(KEY)) ?? {};
  } catch {
    return {};
  }
}
function save() {
  localStorage.setItem(KEY, JSON.stringify(kept));
  apply();
}
function apply() {
  const { style, dataset } = $("studio");
  for (const name of ["side", "map"]) {
    if (kept[name]) {
      style.setProperty(`--${name}-size`, `${kept[name]}px`);
    }
  }
  dataset.main = kept.swapped ? "map" : "picture";
  $("swap").setAttribute("aria-pressed", kept.swapped);
  emit("layout");
}
const railWidth = () => $("rail-nav").clientWidth;
const sizeOf = (name) => (name === "side" ? $("side").clientWidth : lower().clientHeight);
const lower = () => (kept.swapped ? $("view") : $("map-panel"));

function splitter(bar, name, sizeAt) {
  const [low, high] = LIMITS[name];
  const set = (size) => {
    const room = name === "side" ? innerWidth * 0.7 : innerHeight * 0.75;
    kept[name] = Math.round(Math.min(high, room, Math.max(low, size)));
    bar.setAttribute("aria-valuenow", kept[name]);
    save();
  };
  bar.setAttribute("aria-valuemin", low);
  bar.setAttribute("aria-valuemax", high);
  bar.setAttribute("aria-valuenow", kept[name] ?? sizeOf(name));
  bar.onpointerdown = (down) => {
    bar.setPointerCapture(down.pointerId);
    bar.onpointermove = (e) => set(sizeAt(e));
  };
  bar.onpointerup = bar.onpointercancel = () => (bar.onpointermove = null);
  bar.ondblclick = () => {
    kept[name] = null;
    $("studio").style.removeProperty(`--${name}-size`);
    save();
  };
  bar.onkeydown = (e) => {
    const by = { ArrowLeft: STEP, ArrowUp: STEP, ArrowRight: -STEP, ArrowDown: -STEP }[e.key];
    if (by) {
      e.preventDefault();
      e.stopPropagation();
      set(sizeOf(name) + by);
    }
  };
}
