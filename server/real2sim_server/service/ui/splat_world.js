// The scene as Gaussians rendered by this page: one mesh for the background and one per object.
import * as THREE from "three";
import { SparkRenderer, SplatMesh, SplatFileType } from "@sparkjsdev/spark";
import { call } from "./api.js";
import { notify } from "./messages.js";
import { Pace } from "./pace.js";
import { drawInBatches } from "./batches.js";
import { skyOf, turnSky } from "./splat_sky.js";

// The first part is small, for a fast first picture.
const PARTS = [8_192, 32_768];
const TOO_LONG = 700; // ms of a picture of everything
const [NEAR, FAR] = [0.1, 4000];
const BLUR = 0.3; // px^2, as the worker's renderer has it
// Camera columns here are right, up, back; elsewhere right, down, forward.
const TO_THREE = new THREE.Matrix4().makeScale(1, -1, -1);

export class SplatWorld {
  // draw: called for each picture, with look() and draw(); again: called if objects must be placed
  // again because someone walks. Throws without WebGL2.
  constructor(canvas, scene, { draw: picture, again }) {
    Object.assign(this, { scene, again, clouds: new Map(), groups: new Map(), splats: new Map() });
    this.walking = new Set();
    Object.assign(this, {
      loading: false,
      share: 1,
      scale: 1,
      received: { parts: 0, total: null },
    });
    const kept = { antialias: false, alpha: false, preserveDrawingBuffer: true };
    this.renderer = new THREE.WebGLRenderer({ canvas, ...kept });
    this.pace = new Pace(this.renderer.getContext(), this, picture);
    this.world = new THREE.Scene();
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      onDirty: () => this.request(),
      accumExtSplats: true,
      sortRadial: false,
      preBlurAmount: BLUR,
      maxStdDev: 3,
    });
    drawInBatches(this.spark);
    this.world.add(this.spark);
    this.camera = new THREE.PerspectiveCamera();
    this.camera.matrixAutoUpdate = this.camera.matrixWorldAutoUpdate = false;
  }
  url(rest, query = {}) {
    const known = { content_hash: this.scene.content_hash, ...query };
    return `/v1/scenes/${encodeURIComponent(this.scene.scene)}/${rest}?${new URLSearchParams(known)}`;
  }
  async file(path) {
    const answer = await call("GET", path, { accept: "*/*" });
    const total = Number(answer.headers.get("X-Real2Sim-Total"));
    const figure = answer.headers.get("X-Real2Sim-Figure");
    return { total, figure, fileBytes: new Uint8Array(await answer.arrayBuffer()) };
  }
  part(query) {
    return this.file(this.url("splats", { ...query, up_axis: "z" }));
  }
  async mesh(options) {
    const mesh = new SplatMesh({ fileType: SplatFileType.SPZ, extSplats: true, ...options });
    await mesh.initialized;
    this.splats.set(mesh.extSplats, { count: mesh.extSplats.numSplats, uses: 0 });
    return mesh;
  }
  // Load everything, largest first; the next part downloads while one is unpacked. Returns false if
  // drawing everything would be too slow, as without a GPU; it then stops after the second part.
  async load() {
    this.loading = true;
    const sky = this.loadSky();
    let first = 0;
    let count = PARTS[0];
    let coming = this.part({ first, count });
    for (let total = 1; first < total;) {
      const { total: there, fileBytes } = await coming;
      total = there;
      const before = first;
      first += count;
      count = PARTS[1];
      coming = first < total ? this.part({ first, count }) : null;
      if (total) {
        const mesh = await this.mesh({ fileBytes });
        Object.assign(this.splats.get(mesh.extSplats), { uses: 1, before });
        this.world.add(mesh);
      }
      this.received = { parts: this.received.parts + 1, total };
      await sky;
      this.moved();
      if (this.received.parts === 2 && coming && (await this.tooSlow(total - first))) {
        coming.catch(() => {});
        this.pace.stop();
        return false;
      }
    }
    this.loading = false;
    this.moved();
    return true;
  }
  // Whether a picture with this many more Gaussians takes too long.
  async tooSlow(more) {
    const took = await this.pace.fastest(2);
    return (took * (this.total() + more)) / this.pace.detail.shown > TOO_LONG;
  }
  async loadSky() {
    let answer;
    try {
      answer = await call("GET", this.url("sky"), { accept: "image/png" });
    } catch (error) {
      if (error.status === 404) {
        return;
      }
      throw error;
    }
    this.sky = await skyOf(await answer.blob());
    this.world.add(this.sky);
  }
  // Objects with the same appearance share Gaussians; walking people have new ones at each time.
  cloud({ key, path, fleeting }) {
    if (fleeting) {
      return this.cloudAt(path);
    }
    if (!this.clouds.has(key)) {
      this.clouds.set(key, this.cloudAt(path));
    }
    return this.clouds.get(key);
  }
  async cloudAt(path) {
    const { figure, fileBytes } = await this.file(path);
    // The rest pose is not an appearance to show.
    const splats = figure === "rest" ? null : (await this.mesh({ fileBytes })).extSplats;
    if (splats) {
      splats.numSplats = Math.ceil(this.share * splats.numSplats);
    }
    return { splats, walks: figure !== null };
  }
  // places: current objects: {id, look, position, quaternion, scale}; a look is {key, who, path,
  // fleeting}: its key, its object, its URL, and whether it is valid for this time only.
  place(places) {
    const there = new Set(places.map(({ id }) => id));
    for (const [id, group] of this.groups) {
      group.visible = there.has(id);
    }
    for (const { id, look, position, quaternion, scale } of places) {
      if (!this.groups.has(id)) {
        this.groups.set(id, new THREE.Group());
        this.world.add(this.groups.get(id));
      }
      const group = this.groups.get(id);
      const [w, x, y, z] = quaternion;
      group.position.set(...position);
      group.quaternion.set(x, y, z, w);
      group.scale.setScalar(scale);
      group.userData.wanted = look;
      this.fill(group);
    }
    this.moved();
  }
  // One look at a time is loaded; then the one needed by then.
  async fill(group) {
    const now = group.userData;
    const { wanted } = now;
    if (now.busy || now.shown === wanted.key) {
      return;
    }
    now.busy = true;
    try {
      const { splats, walks } = await this.cloud(wanted);
      if (walks && !this.walking.has(wanted.who)) {
        this.walking.add(wanted.who);
        this.again();
      }
      if (splats) {
        const mesh = new SplatMesh({ extSplats: splats });
        await mesh.initialized;
        this.empty(group);
        group.add(mesh);
        this.splats.get(splats).uses += 1;
        now.fleeting = wanted.fleeting && splats;
      }
    } catch (error) {
      notify(error.message, "bad");
    }
    now.shown = wanted.key;
    now.busy = false;
    this.moved();
    this.fill(group);
  }
  empty(group) {
    for (const mesh of group.children) {
      this.splats.get(mesh.extSplats).uses -= 1;
    }
    group.clear();
    if (group.userData.fleeting) {
      this.splats.delete(group.userData.fleeting);
      group.userData.fleeting.dispose();
    }
  }
  // Whether an object exists but has nothing to show.
  isMissing(id) {
    return !this.groups.get(id)?.children.length;
  }
  // view: {width, height [css px], ratio, K: 9 values, T: 16 values}.
  look({ width, height, ratio: finest, K, T }) {
    const ratio = finest * this.scale;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    const [fx, cx, fy, cy] = [K[0], K[2], K[4], K[5]];
    const [left, right] = [(-NEAR * cx) / fx, (NEAR * (width - cx)) / fx];
    const [top, bottom] = [(NEAR * cy) / fy, (-NEAR * (height - cy)) / fy];
    this.camera.projectionMatrix.makePerspective(left, right, top, bottom, NEAR, FAR);
    this.camera.projectionMatrixInverse.copy(this.camera.projectionMatrix).invert();
    this.camera.matrixWorld.set(...T).multiply(TO_THREE);
    this.camera.matrix.copy(this.camera.matrixWorld);
    this.camera.matrixWorldInverse.copy(this.camera.matrixWorld).invert();
    this.camera.matrix.decompose(this.camera.position, this.camera.quaternion, this.camera.scale);
    if (this.sky) {
      const lens = [fx * ratio, fy * ratio, cx * ratio, cy * ratio];
      turnSky(this.sky, { T, lens, rows: Math.floor(height * ratio) });
    }
  }
  moved() {
    this.pace.moved();
  }
  request() {
    this.pace.request();
  }
  ordering() {
    return this.spark.sorting || this.spark.sortDirty;
  }
  total() {
    return [...this.splats.values()].reduce((sum, { count, uses }) => sum + count * uses, 0);
  }
  // Whether other Gaussians are shown than before.
  show({ share, scale }) {
    Object.assign(this, { share, scale });
    const parts = [...this.splats.values()].filter(({ before }) => before !== undefined);
    const background = share * parts.reduce((sum, { count }) => sum + count, 0);
    let changed = false;
    for (const [splats, { count, before }] of this.splats) {
      const wanted = before === undefined ? share * count : background - before;
      const shown = Math.min(count, Math.max(0, Math.ceil(wanted)));
      changed ||= shown !== splats.numSplats;
      splats.numSplats = shown;
    }
    return changed;
  }
  // The Gaussians shown from now on, without redrawing the previous picture.
  async reorder() {
    this.world.updateMatrixWorld();
    await this.spark.update({ scene: this.world, camera: this.camera });
  }
  draw() {
    this.renderer.render(this.world, this.camera);
  }
}
