// Lanes of the scene's map, seen from above: surface, centre, direction, stop lines, signals.
import { ink } from "./theme.js";

export function drawLanes(pen, toScreen, lanes) {
  const shapes = lanes.lanes.map((lane) => ({ lane, ...rims(lane) }));
  for (const { lane, left, right } of shapes) {
    trace(pen, [...left, ...right.slice().reverse()].map(toScreen), true);
    const { lanes: surfaces } = ink();
    pen.fillStyle = surfaces[lane.kind] ?? surfaces.other;
    pen.fill();
  }
  for (const area of lanes.areas) {
    trace(pen, area.outline.map(toScreen), true);
    pen.fillStyle = area.kind === "crosswalk" ? ink().crossing : ink().area;
    pen.fill();
  }
  pen.lineWidth = 1;
  for (const { lane, left, right } of shapes) {
    stroke(pen, left.map(toScreen), ink().rim);
    stroke(pen, right.map(toScreen), ink().rim);
    if (lane.kind === "driving" || lane.kind === "bus") {
      pen.setLineDash([5, 6]);
      stroke(pen, lane.centre.map(toScreen), ink().middle);
      pen.setLineDash([]);
      arrow(pen, toScreen, lane.centre);
    }
  }
  pen.lineWidth = 2;
  lanes.stop_lines.forEach((line) => stroke(pen, line.points.map(toScreen), ink().stop));
  for (const signal of lanes.signals) {
    const [x, y] = toScreen(signal.position);
    pen.fillStyle = signal.kind === "traffic_light" ? "#e5c07b" : ink().collider;
    pen.fillRect(x - 3, y - 3, 6, 6);
  }
}

// Offset of half the width from the centre line, normal to the mean of adjacent segments.
function rims({ centre, widths }) {
  const left = [];
  const right = [];
  centre.forEach(([x, y], i) => {
    const a = centre[Math.max(i - 1, 0)];
    const b = centre[Math.min(i + 1, centre.length - 1)];
    const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
    const aside = widths[i] / 2 / length;
    const [dx, dy] = [-(b[1] - a[1]) * aside, (b[0] - a[0]) * aside];
    left.push([x + dx, y + dy]);
    right.push([x - dx, y - dy]);
  });
  return { left, right };
}
function arrow(pen, toScreen, centre) {
  const k = Math.floor(centre.length / 2);
  const [x0, y0] = toScreen(centre[k - 1]);
  const [x1, y1] = toScreen(centre[k]);
  const angle = Math.atan2(y1 - y0, x1 - x0);
  pen.strokeStyle = ink().middle;
  pen.beginPath();
  for (const side of [-2.6, 2.6]) {
    pen.moveTo(x1, y1);
    pen.lineTo(x1 + 8 * Math.cos(angle + side), y1 + 8 * Math.sin(angle + side));
  }
  pen.stroke();
}
function trace(pen, points, closed) {
  pen.beginPath();
  points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
  if (closed) {
    pen.closePath();
  }
}
function stroke(pen, points, colour) {
  trace(pen, points, false);
  pen.strokeStyle = colour;
  pen.stroke();
}
