/**
 * The ego motions of a sequence, which lead from the frame of an earlier sweep to a later one.
 */

import { identity, multiply, transposed } from "./matrix.js";

/** Pairs before the shown sweep whose ego motion is fetched for the paths of tracks. */
const FETCHED = 12;

/** Ego motions by the sweep at which they begin. */
export class Egos {
  #known = new Map();

  /** @param {Object} scene Descriptions of pairs may have `ego`, 4 x 4 numbers row by row. */
  constructor(scene) {
    this.scene = scene;
    for (const { source, ego } of scene.pairs) if (ego) this.#known.set(source, transposed(Array.from(ego).flat()));
  }

  /** Takes the ego motion of a pair that was loaded. */
  learn(sweep, pair) {
    if (pair?.ego) this.#known.set(sweep, transposed(pair.ego));
  }

  /**
   * Fetches what is missing before a sweep, one pair after the other.
   *
   * @param {number} sweep
   * @param {() => boolean} isWanted Whether to go on.
   * @returns {Promise<boolean>} Whether something was found.
   */
  async fetchBefore(sweep, isWanted) {
    let isNew = false;
    for (let at = sweep - 1; at >= Math.max(0, sweep - FETCHED) && isWanted(); at -= 1) {
      if (this.#known.has(at)) continue;
      const pair = await this.scene.pair(at).catch(() => null);
      if (!pair?.ego) return isNew;
      this.learn(at, pair);
      isNew = true;
    }
    return isNew;
  }

  /** The map from the frame of one sweep to that of a later one; null where one is missing. */
  between(from, to) {
    let matrix = identity();
    for (let sweep = from; sweep < to; sweep += 1) {
      const ego = this.#known.get(sweep);
      if (!ego) return null;
      matrix = multiply(ego, matrix);
    }
    return matrix;
  }
}
