// Scheduling of pictures and their number of Gaussians, from measured times of the device.
import { Detail } from "./detail.js";

const RESTS_AFTER_MS = 350;
const ORDERED_MS = 4;

// One picture at a time is in progress, so that input never waits for several.
export class Pace {
  // world: what to draw, with total(), show(), reorder(), ordering() and loading; picture: draws
  // it.
  constructor(gl, world, picture) {
    Object.assign(this, { gl, world, picture, detail: new Detail(), begun: null, rests: 0 });
    Object.assign(this, { wanted: false, waiting: false, preparing: false, prepared: false });
    Object.assign(this, { stopped: false, onPicture: () => {} });
  }
  // Something moves: pictures keep the frame time, and show everything once it rests.
  moved() {
    this.rests = performance.now() + RESTS_AFTER_MS;
    this.request();
  }
  request() {
    this.wanted = true;
    this.later();
  }
  later() {
    if (!this.waiting && !this.stopped) {
      this.waiting = true;
      requestAnimationFrame(() => {
        this.waiting = false;
        this.next();
      });
    }
  }
  next() {
    if (this.preparing || (this.begun && !this.finished())) {
      this.later();
      return;
    }
    const total = this.world.total();
    const resting = this.resting();
    const refines = resting && !this.wanted && !this.whole() && !this.world.ordering();
    if ((this.wanted && !resting) || refines) {
      const chosen = refines ? this.detail.resting(total) : this.detail.moving(total);
      // At most once before a picture: walking people change Gaussians at any time.
      if (this.world.show(chosen) && !this.prepared) {
        this.prepare();
        return;
      }
      // Draw even if the Gaussians are unchanged: they may now be the whole scene.
      this.wanted = true;
    }
    if (this.wanted) {
      this.draw(resting);
    }
    if (this.wanted || this.begun || !resting || !this.whole() || this.world.ordering()) {
      this.later();
    }
  }
  resting() {
    return !this.world.loading && performance.now() > this.rests;
  }
  whole() {
    return !this.world.loading && this.detail.whole(this.world.total());
  }
  // The set of Gaussians has changed. The next picture waits until they are sorted, because a
  // picture with the old ones would take as long.
  async prepare() {
    this.preparing = true;
    while (this.world.ordering()) {
      await new Promise((done) => setTimeout(done, ORDERED_MS));
    }
    await this.world.reorder();
    this.preparing = false;
    this.prepared = true;
    this.request();
  }
  draw(resting) {
    this.wanted = this.prepared = false;
    const at = performance.now();
    this.picture();
    const fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.begun = { fence, at, resting };
  }
  finished() {
    const { fence, at, resting } = this.begun;
    if (this.gl.clientWaitSync(fence, 0, 0) === this.gl.TIMEOUT_EXPIRED) {
      return false;
    }
    this.gl.deleteSync(fence);
    this.begun = null;
    const took = performance.now() - at;
    this.detail.took(took, { resting });
    this.onPicture(took);
    return true;
  }
  // Stop drawing.
  stop() {
    this.stopped = true;
  }
  // The fastest of the next few pictures [ms]; the first one compiles programs.
  async fastest(count) {
    let least = Infinity;
    for (let k = 0; k < count; k++) {
      const taken = new Promise((tell) => (this.onPicture = tell));
      this.moved();
      least = Math.min(least, await taken);
    }
    return least;
  }
}
