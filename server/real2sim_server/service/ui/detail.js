// How much of a scene a picture shows: all of it at rest; while something moves, what is drawn in
// time. Gaussians are in the order of what covers most, so that the first of them tell the most.
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
  // For a picture while something moves, out of so many Gaussians.
  moving(total) {
    // Powers of two, since another number has all of them sorted anew.
    const step = 2 ** Math.round(Math.log2(this.budget));
    this.shown = step > 0.7 * total ? total : step;
    return this.now(total);
  }
  // For the next picture at rest: in steps where all at once would take long.
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
  // A picture of what was chosen last has taken so long.
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
