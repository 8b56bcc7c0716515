// Number of Gaussians in a picture: all at rest; while something moves, as many as fit the frame
// time. Gaussians are ordered by covered area, so the first ones matter most.
const IN_TIME = 34; // ms
const FIRST = 24_000;
const LEAST = 16_000;
const LEAST_SCALE = 0.4;
const FINE = 2; // pixels across, beside the root of the share of Gaussians
const STEP = 6;

export class Detail {
  constructor() {
    this.budget = FIRST;
    this.shown = 0;
  }
  // For a picture while something moves, given the number of Gaussians.
  moving(total) {
    // Powers of two, because any other number sorts all Gaussians again.
    const step = 2 ** Math.round(Math.log2(this.budget));
    this.shown = step > 0.7 * total ? total : step;
    return this.now(total);
  }
  // For the next picture at rest, in steps if all at once would take too long.
  resting(total) {
    const next = this.budget >= total ? total : this.shown * STEP;
    this.shown = next > 0.6 * total ? total : next;
    return this.now(total);
  }
  now(total) {
    const share = total ? Math.min(1, this.shown / total) : 1;
    return { share, scale: Math.max(LEAST_SCALE, Math.min(1, FINE * Math.sqrt(share))) };
  }
  whole(total) {
    return this.shown >= total;
  }
  // Report the duration of the last picture.
  took(ms, { resting }) {
    const fitting = (this.shown * IN_TIME) / Math.max(1, ms);
    if (ms <= IN_TIME) {
      this.budget = Math.max(this.budget, fitting);
    } else if (!resting) {
      this.budget = Math.max(LEAST, Math.sqrt(this.budget * fitting));
    } else if (this.budget > this.shown) {
      this.budget = Math.max(LEAST, fitting);
    }
  }
}
