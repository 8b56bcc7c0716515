// The panels. To add one, write a module and add an entry here: `start` fills the element of its id
// when the studio opens; `shown` runs each time the panel is opened.
import { startProperties } from "./properties.js";
import { startAssets } from "./assets.js";
import { startPhysics } from "./physics.js";
import { startDatasets, listDatasets } from "./datasets.js";
import { startDrive, listDrives } from "./drive.js";
import { startWork, listWork } from "./work.js";
import { startLog } from "./log.js";
import { emit } from "./model.js";
import { el } from "./dom.js";

const PANELS = [
  {
    id: "properties",
    label: "Object",
    icon: "M3 7l7-4 7 4v7l-7 4-7-4zM3 7l7 4 7-4M10 11v7",
    start: startProperties,
  },
  {
    id: "assets",
    label: "Assets",
    icon: "M3 3h6v6H3zM11 3h6v6h-6zM3 11h6v6H3zM11 11h6v6h-6z",
    start: startAssets,
  },
  { id: "physics", label: "Physics", icon: "M3 16h14M5 16l5-11 5 11M8 9h4", start: startPhysics },
  {
    id: "drive",
    label: "Drive",
    icon: "M10 3a7 7 0 1 0 .01 0M10 8a2 2 0 1 0 .01 0M3.4 9h4.8M11.8 9h4.8M10 12v5",
    start: startDrive,
    shown: listDrives,
  },
  {
    id: "datasets",
    label: "Data sets",
    icon: "M3 4h14v12H3zM3 12l4-4 4 4 2-2 4 4",
    start: startDatasets,
    shown: listDatasets,
  },
  {
    id: "work",
    label: "Work",
    icon: "M4 6h12M4 10h12M4 14h7M14 13l2 2 3-4",
    start: startWork,
    shown: listWork,
  },
  {
    id: "log",
    label: "History",
    icon: "M10 3a7 7 0 1 0 7 7M10 6v4l3 2M17 3v4h-4",
    start: startLog,
  },
];
const KEY = "real2sim-panel";
const $ = (id) => document.getElementById(id);
const tabs = () => [...$("rail").querySelectorAll("[role=tab]")];

export function startPanels() {
  for (const { id, label, icon, start } of PANELS) {
    $("rail").append(tab(id, label, icon));
    $("side").append(page(id));
    start();
  }
  const before = localStorage.getItem(KEY);
  turnTo(PANELS.some((p) => p.id === before) ? before : PANELS[0].id);
}
export function turnTo(id) {
  for (const button of tabs()) {
    const chosen = button.dataset.tab === id;
    button.setAttribute("aria-selected", chosen);
    button.tabIndex = chosen ? 0 : -1;
    $(button.dataset.tab).hidden = !chosen;
  }
  localStorage.setItem(KEY, id);
  PANELS.find((p) => p.id === id).shown?.();
  emit("layout");
}
function page(id) {
  const made = el("div", { id, hidden: true, tabIndex: 0, "data-page": id });
  made.setAttribute("role", "tabpanel");
  made.setAttribute("aria-labelledby", `tab-${id}`);
  return made;
}
function tab(id, label, icon) {
  const button = el(
    "button",
    { "data-tab": id, "aria-controls": id, onclick: () => turnTo(id), onkeydown: walk },
    picture(icon),
    el("span", { textContent: label }),
  );
  button.id = `tab-${id}`;
  button.setAttribute("role", "tab");
  return button;
}
function picture(path) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 20 20");
  svg.setAttribute("aria-hidden", "true");
  const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
  line.setAttribute("d", path);
  svg.append(line);
  return svg;
}
// Arrow keys move between tabs, as in any tab list.
function walk(e) {
  const all = tabs();
  const here = all.indexOf(e.currentTarget);
  const to = {
    ArrowDown: here + 1,
    ArrowRight: here + 1,
    ArrowUp: here - 1,
    ArrowLeft: here - 1,
    Home: 0,
    End: all.length - 1,
  }[e.key];
  if (to === undefined) {
    return;
  }
  e.preventDefault();
  e.stopPropagation();
  const next = all.at(to % all.length);
  turnTo(next.dataset.tab);
  next.focus();
}
