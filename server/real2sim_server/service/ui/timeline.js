// Time: a slider, play, single steps, speed.
import { model, on, emit, setTime, span } from "./model.js";

const $ = (id) => document.getElementById(id);
let playing = false;
let last = 0;

export function startTimeline() {
  $("time").oninput = (e) => setTime(Number(e.target.value));
  $("play").onclick = toggle;
  $("back").onclick = () => step(-1);
  $("next").onclick = () => step(1);
  on("time scenario run", draw);
  draw();
}
function draw() {
  const { start_us: start, end_us: end } = span();
  Object.assign($("time"), { min: start, max: end, value: model.t });
  $("clock").textContent =
    `${((model.t - start) / 1e6).toFixed(2)} / ${((end - start) / 1e6).toFixed(2)} s`;
  $("play").textContent = playing ? "Pause" : "Play";
}
export function toggle() {
  if (model.live) {
    emit("drive-toggle");
    return;
  }
  playing = !playing;
  if (playing && model.t >= span().end_us) {
    setTime(span().start_us);
  }
  last = performance.now();
  if (playing) {
    requestAnimationFrame(tick);
  }
  draw();
}
function tick(now) {
  if (!playing) {
    return;
  }
  const t = model.t + (now - last) * 1000 * Number($("speed").value);
  last = now;
  if (t >= span().end_us) {
    playing = false;
  }
  setTime(t);
  if (playing) {
    requestAnimationFrame(tick);
  }
}
export function step(direction) {
  playing = false;
  const times = model.playback?.times_us ?? model.scene.frame_times_us;
  const next = direction > 0 ? times.find((t) => t > model.t) : times.findLast((t) => t < model.t);
  setTime(next ?? model.t);
  draw();
}
