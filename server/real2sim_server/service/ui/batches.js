// Groups Gaussians into instances: software renderers pay per instance, and GPUs are better used.
import * as THREE from "three";

const EACH = 128;
const CORNERS = [-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0];
const FACES = [0, 1, 2, 0, 2, 3];

export function drawInBatches(spark) {
  const corners = new Float32Array(EACH * CORNERS.length);
  const faces = new Uint16Array(EACH * FACES.length);
  for (let k = 0; k < EACH; k++) {
    corners.set(CORNERS, k * CORNERS.length);
    faces.set(
      FACES.map((corner) => corner + 4 * k),
      k * FACES.length,
    );
  }
  spark.geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
  spark.geometry.setIndex(new THREE.BufferAttribute(faces, 1));
  const { material, uniforms } = spark;
  uniforms.ordered = { value: 0 };
  material.vertexShader = `uniform int ordered;\n${material.vertexShader}`
    .replaceAll("gl_InstanceID", `(gl_InstanceID * ${EACH} + gl_VertexID / 4)`)
    .replace(
      "if (splatIndex == 0xffffffffu)",
      `if (splatIndex == 0xffffffffu || gl_InstanceID * ${EACH} + gl_VertexID / 4 >= ordered)`,
    );
  const prepare = spark.onBeforeRender;
  spark.onBeforeRender = (...given) => {
    prepare.apply(spark, given);
    uniforms.ordered.value = spark.activeSplats;
    spark.geometry.instanceCount = Math.ceil(spark.activeSplats / EACH);
  };
}
