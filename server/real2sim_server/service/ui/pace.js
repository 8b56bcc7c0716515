// When pictures are drawn, and how much of the scene they show: what a device takes is measured.
import { Detail } from "./detail.js";

const RESTS_AFTER_MS = 350;
const ORDERED_MS = 4;

// One picture at a time is under way, so that hands never wait for several.
export class Pace {
  // world: what is drawn, by total(), show(), reorder(), ordering() and loading; picture: draws it.
  constructor(gl, world, picture) {
    Object.assign(this, { gl, world, picture, detail: new Detail(), begun: null, rests: 0 });
    Object.assign(this, { wanted: false, waiting: false, preparing: false, prepared: false });
    Object.assign(this, { stopped: false, onPicture: () => {} });
  }
  // Something moves: pictures come in time, and show all once it rests.
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
      // At most once before a picture: who walks brings others at any time.
      if (this.world.show(chosen) && !this.prepared) {
        this.prepare();
        return;
      }
      // Draw even where the same Gaussians are shown: they may be the whole scene now.
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
  // Others are shown from now on: the next picture waits until they are in order, since another
  // one of those before would take as long as they do.
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
  // No more pictures.
  stop() {
    this.stopped = true;
  }
  // The quickest of the next few pictures [ms]; the first one of anything new waits for its programs.
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
