// Poses: quaternions are wxyz, positions metres in the world, times microseconds.
export const yawOf = ([w, x, y, z]) => Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));

export const multiply = ([a, b, c, d], [e, f, g, h]) => [
  a * e - b * f - c * g - d * h,
  a * f + b * e + c * h - d * g,
  a * g - b * h + c * e + d * f,
  a * h + b * g - c * f + d * e,
];

export const aboutZ = (yaw) => [Math.cos(yaw / 2), 0, 0, Math.sin(yaw / 2)];

export function poseAt(track, t) {
  const { times_us: times, positions, quaternions } = track;
  let high = times.findIndex((time) => time >= t);
  if (high < 0) {
    high = times.length - 1;
  }
  const low = Math.max(0, high - 1);
  const span = times[high] - times[low];
  const share = span > 0 ? Math.min(1, Math.max(0, (t - times[low]) / span)) : 1;
  const blend = (a, b) => a.map((value, i) => value + (b[i] - value) * share);
  const from = quaternions[low];
  const sign = from.reduce((sum, q, i) => sum + q * quaternions[high][i], 0) < 0 ? -1 : 1;
  const mixed = blend(
    from,
    quaternions[high].map((q) => q * sign),
  );
  const length = Math.hypot(...mixed);
  return {
    position: blend(positions[low], positions[high]),
    quaternion: mixed.map((q) => q / length),
  };
}

export const present = (object, t) => t >= object.start_us && t <= object.end_us;

export function rotate([w, x, y, z], [a, b, c]) {
  const u = 2 * (y * c - z * b);
  const v = 2 * (z * a - x * c);
  const s = 2 * (x * b - y * a);
  return [a + w * u + y * s - z * v, b + w * v + z * u - x * s, c + w * s + x * v - y * u];
}

// World point to pixel; null behind the camera. T: 16 values, K: 9 values.
export function project(point, T, K) {
  const d = [point[0] - T[3], point[1] - T[7], point[2] - T[11]];
  const [x, y, z] = [0, 1, 2].map((i) => T[i] * d[0] + T[4 + i] * d[1] + T[8 + i] * d[2]);
  return z < 0.1 ? null : [(K[0] * x) / z + K[2], (K[4] * y) / z + K[5]];
}
