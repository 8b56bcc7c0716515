// The free camera: drag to look, right-drag or two fingers to move, scroll or pinch to go forward.
import { model, emit } from "./model.js";

const LOOK = 0.004; // rad of a pixel
const MOVE = 0.02; // m of a pixel
const fingers = new Map();
let moved = 0;

// tapped: callback for pointers that neither dragged nor pinched.
export function startFlight(stage, tapped) {
  stage.addEventListener("contextmenu", (e) => e.preventDefault());
  stage.addEventListener("pointerdown", (e) => {
    if (!fingers.size) {
      moved = 0;
    }
    fingers.set(e.pointerId, keep(e));
    if (model.free) {
      stage.setPointerCapture(e.pointerId);
    }
  });
  stage.addEventListener("pointermove", drag);
  stage.addEventListener("pointerup", (e) => {
    const from = fingers.get(e.pointerId);
    fingers.delete(e.pointerId);
    if (from && moved < 8 && from.button === 0 && !fingers.size) {
      tapped(e);
    }
  });
  for (const end of ["pointercancel", "pointerleave"]) {
    stage.addEventListener(end, (e) => fingers.delete(e.pointerId));
  }
  stage.addEventListener(
    "wheel",
    (e) => {
      if (model.free) {
        e.preventDefault();
        shift(0, 0, -e.deltaY * 0.01);
      }
    },
    { passive: false },
  );
}
const keep = ({ clientX, clientY, button }) => ({ clientX, clientY, button });
function drag(e) {
  const from = fingers.get(e.pointerId);
  if (!from) {
    return;
  }
  const [dx, dy] = [e.clientX - from.clientX, e.clientY - from.clientY];
  const before = spread();
  fingers.set(e.pointerId, { ...keep(e), button: from.button });
  moved += Math.abs(dx) + Math.abs(dy);
  if (!model.free) {
    return;
  }
  if (fingers.size === 2) {
    shift((-dx * MOVE) / 2, (-dy * MOVE) / 2, (spread() - before) * MOVE);
  } else if (from.button === 2) {
    shift(-dx * MOVE, -dy * MOVE, 0);
  } else {
    turn(dx * LOOK, dy * LOOK);
  }
}
function spread() {
  const [a, b] = fingers.values();
  return b ? Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY) : 0;
}

// Camera axes are the columns of T: right, down, forward.
export function shift(right, down, forward) {
  const T = model.free.slice();
  for (let i = 0; i < 3; i++) {
    T[4 * i + 3] += T[4 * i] * right + T[4 * i + 1] * down + T[4 * i + 2] * forward;
  }
  model.free = T;
  emit("camera");
}
function turn(yaw, pitch) {
  const T = model.free.slice();
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  const [d, e] = [Math.cos(pitch), Math.sin(pitch)];
  for (let column = 0; column < 3; column++) {
    const [x, y] = [T[column], T[4 + column]];
    T[column] = c * x - s * y;
    T[4 + column] = s * x + c * y;
  }
  for (let i = 0; i < 3; i++) {
    const [down, forward] = [T[4 * i + 1], T[4 * i + 2]];
    T[4 * i + 1] = d * down + e * forward;
    T[4 * i + 2] = d * forward - e * down;
  }
  model.free = T;
  emit("camera");
}
