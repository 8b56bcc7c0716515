// Colliders on the map.
import { rotate } from "./poses.js";

// The size of a box in the collider's own frame, or lines in the world.
export function fromAbove(shape) {
  const across = 2 * shape.radius;
  switch (shape.kind) {
    case "box":
      return { size: shape.size };
    case "cylinder":
      return { size: [across, across, shape.height] };
    case "capsule":
      return { size: [across, across, shape.length + across] };
    case "mesh":
      return { lines: shape.triangles.map((corners) => triangle(shape, corners)) };
    default:
      return {};
  }
}

function triangle({ position, quaternion, vertices }, [a, b, c]) {
  return [a, b, c, a].map((k) =>
    rotate(quaternion, vertices[k]).map((v, axis) => v + position[axis]),
  );
}
