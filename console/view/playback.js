/**
 * Moves the time on while the viewer plays.
 */

/** Seconds in which a single pair plays, and in which it then rests. */
const PAIR_S = 1.6;
const REST_S = 0.5;

/** Longest time that one picture moves on, seconds. */
const LONGEST_S = 0.25;

/** The playing of a viewer: `state.time` from 0 to 1, and on to the next sweep. */
export class Playback {
  #then = 0;
  #rest = 0;
  #isLoading = false;

  /** @param {Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
  }

  /** Plays or pauses. A sequence pauses at the shown sweep, a pair where it is. */
  set(isPlaying) {
    const { viewer } = this;
    const { state } = viewer;
    state.isPlaying = isPlaying;
    this.#then = performance.now();
    this.#rest = 0;
    if (viewer.isSequence && !isPlaying) state.time = 0;
    else if (isPlaying && state.time === 1) state.time = 0;
    viewer.redraw();
  }

  /** Moves on to the time of a picture, milliseconds. */
  advance(now) {
    const { state, frame, isSequence } = this.viewer;
    const passed = Math.min(LONGEST_S, Math.max(0, (now - this.#then) / 1000));
    this.#then = now;
    if (!state.isPlaying || this.#isLoading) return;
    const seconds = isSequence ? (frame?.pair?.dt ?? 0.1) : PAIR_S;
    const time = state.time + (state.speed * passed) / seconds;
    state.time = Math.min(1, time);
    if (time < 1) return;
    if (isSequence) void this.#next(Math.min(0.9, time - 1));
    else if ((this.#rest += passed) > REST_S) [state.time, this.#rest] = [0, 0];
  }

  async #next(time) {
    const { viewer } = this;
    const next = (viewer.state.sweep + 1) % viewer.scene.sweeps;
    this.#isLoading = true;
    try {
      await viewer.show(next);
    } finally {
      this.#isLoading = false;
    }
    // A sweep that cannot be loaded ends the playing; its message stays.
    if (viewer.state.sweep !== next) this.set(false);
    if (viewer.state.isPlaying) viewer.state.time = next === 0 ? 0 : time;
    viewer.redraw();
  }
}
