// Line plots over time on a canvas.
import { ink } from "./theme.js";

export function plot(canvas, xs, series, now) {
  if (!canvas?.clientWidth) {
    return;
  }
  const [w, h, r] = [canvas.clientWidth, canvas.clientHeight, devicePixelRatio];
  canvas.width = w * r;
  canvas.height = h * r;
  const pen = canvas.getContext("2d");
  pen.scale(r, r);
  const all = series.flatMap((s) => s.values);
  const low = Math.min(0, ...all);
  const high = Math.max(...all, low + 1e-6);
  const x = (v) => 34 + (v / (xs.at(-1) || 1)) * (w - 40);
  const y = (v) => h - 30 - ((v - low) / (high - low)) * (h - 38);
  pen.font = "10px system-ui";
  const { lines, faint, grid, text } = ink();
  pen.fillStyle = faint;
  pen.strokeStyle = grid;
  for (const v of [low, (low + high) / 2, high]) {
    pen.beginPath();
    pen.moveTo(34, y(v));
    pen.lineTo(w, y(v));
    pen.stroke();
    pen.fillText(v.toPrecision(3), 0, y(v) + 3);
  }
  series.forEach((s, k) => {
    pen.strokeStyle = pen.fillStyle = lines[k % lines.length];
    pen.beginPath();
    s.values.forEach((v, i) => pen.lineTo(x(xs[i]), y(v)));
    pen.stroke();
    pen.fillText(s.name.replace("_", " "), 4 + (k % 3) * (w / 3), h - 14 + Math.floor(k / 3) * 12);
  });
  pen.strokeStyle = text;
  pen.beginPath();
  pen.moveTo(x(now), 4);
  pen.lineTo(x(now), h - 30);
  pen.stroke();
}
