// The sky: a cube map behind everything, six faces side by side (docs/rest.md).
import * as THREE from "three";

const SKY_VERTEX = "void main() { gl_Position = vec4(position.xy, 1.0, 1.0); }";
const SKY_FRAGMENT = `
uniform sampler2D faces;
uniform mat3 turn;
uniform vec4 lens;
uniform float height;
void main() {
  vec2 pixel = vec2(gl_FragCoord.x, height - gl_FragCoord.y);
  vec3 d = turn * vec3((pixel - lens.zw) / lens.xy, 1.0);
  vec3 a = abs(d);
  float face;
  vec2 uv;
  if (a.x >= a.y && a.x >= a.z) {
    face = d.x > 0.0 ? 0.0 : 1.0;
    uv = vec2(-d.y / d.x, -d.z / a.x);
  } else if (a.y >= a.z) {
    face = d.y > 0.0 ? 2.0 : 3.0;
    uv = vec2(d.x / d.y, -d.z / a.y);
  } else {
    face = d.z > 0.0 ? 4.0 : 5.0;
    uv = vec2(-d.y / a.z, d.x / d.z);
  }
  float size = float(textureSize(faces, 0).y);
  vec2 inside = clamp(uv * 0.5 + 0.5, 0.5 / size, 1.0 - 0.5 / size);
  gl_FragColor = vec4(texture2D(faces, vec2((face + inside.x) / 6.0, inside.y)).rgb, 1.0);
}`;

export async function skyOf(blob) {
  const picture = await createImageBitmap(blob);
  const faces = new THREE.Texture(picture);
  faces.flipY = faces.generateMipmaps = false;
  faces.minFilter = faces.magFilter = THREE.LinearFilter;
  faces.needsUpdate = true;
  const plane = new THREE.Mesh(
    new THREE.PlaneGeometry(2, 2),
    new THREE.ShaderMaterial({
      vertexShader: SKY_VERTEX,
      fragmentShader: SKY_FRAGMENT,
      depthTest: false,
      depthWrite: false,
      uniforms: {
        faces: { value: faces },
        turn: { value: new THREE.Matrix3() },
        lens: { value: new THREE.Vector4() },
        height: { value: 1 },
      },
    }),
  );
  plane.frustumCulled = false;
  plane.renderOrder = -1;
  return plane;
}
// The sky as seen by a camera; T: 16 values; rows: height in pixels.
export function turnSky({ material }, { T, lens: focal, rows }) {
  const { turn, lens, height } = material.uniforms;
  turn.value.set(T[0], T[1], T[2], T[4], T[5], T[6], T[8], T[9], T[10]);
  lens.value.set(...focal);
  height.value = rows;
}
