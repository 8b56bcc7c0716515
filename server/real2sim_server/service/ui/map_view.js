// View of the map: world x to the right, y up.
import { model, object, objects, isHere, poseOf, egoPoseAt } from "./model.js";

const SCALES = [0.5, 120];
let canvas;
export let view = { x: 0, y: 0, scale: 6 };

export function useCanvas(given) {
  canvas = given;
}
export function lookAt(next) {
  const [least, most] = SCALES;
  view = { ...next, scale: Math.min(most, Math.max(least, next.scale)) };
}
export const toScreen = ([x, y]) => [
  canvas.clientWidth / 2 + (x - view.x) * view.scale,
  canvas.clientHeight / 2 - (y - view.y) * view.scale,
];
export const toWorld = ({ offsetX, offsetY }) => [
  view.x + (offsetX - canvas.clientWidth / 2) / view.scale,
  view.y - (offsetY - canvas.clientHeight / 2) / view.scale,
];
// The point under the pointer stays in place.
export function zoomAt(place, factor) {
  const [x, y] = toWorld(place);
  const [least, most] = SCALES;
  const scale = Math.min(most, Math.max(least, view.scale * factor));
  const k = view.scale / scale;
  view = { x: x + (view.x - x) * k, y: y + (view.y - y) * k, scale };
}
export const panBy = (dx, dy) =>
  lookAt({ ...view, x: view.x - dx / view.scale, y: view.y + dy / view.scale });

export const shown = () => objects().filter(isHere);
export function lookAtEverything() {
  const points = [...(model.scene.ego?.positions ?? []), ...shown().map((o) => poseOf(o).position)];
  const [xs, ys] = [0, 1].map((k) => points.map((p) => p[k]));
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const fitting = Math.min(
    canvas.clientWidth / (x1 - x0 + 16),
    canvas.clientHeight / (y1 - y0 + 16),
  );
  lookAt({ x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale: Math.min(40, fitting) });
}
// Scroll when something comes near the border.
export function keepInView([x, y]) {
  const [across, down] = toScreen([x, y]);
  const rim = 0.2;
  const inside = (at, size) => at > size * rim && at < size * (1 - rim);
  if (!inside(across, canvas.clientWidth) || !inside(down, canvas.clientHeight)) {
    lookAt({ ...view, x, y });
  }
}
export function lookAtSelection() {
  const subject = object(model.selected);
  const [x, y] = subject ? poseOf(subject).position : egoPoseAt(model.t).position;
  lookAt({ x: subject ? x : x + 12, y, scale: Math.max(view.scale, 9) });
}
