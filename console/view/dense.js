/**
 * A dense cloud as arrays to draw.
 */

import { packed, rampTable } from "./colors.js";
import { HEIGHTS_M } from "./frame.js";

/** What colors of a dense cloud show, by name. */
export const DENSE_COLORS = { height: "Height", sweep: "Sweep", age: "Age", dynamic: "Moving points" };

/** Color of points that move. */
export const MOVING_COLOR = [255, 128, 48];

/** A dense cloud. */
export class Dense {
  /** @param {Object} arrays As `scene.dense` gives them. */
  constructor(arrays) {
    this.arrays = arrays;
    this.position = arrays.points;
    this.count = arrays.points.length / 3;
    this.lastSweep = arrays.sweep.reduce((most, value) => Math.max(most, value), 0);
    this.ages = rangeOf(arrays.age);
  }

  /** The place of a row, metres. */
  place(row) {
    return Array.from(this.position.subarray(3 * row, 3 * row + 3));
  }

  /** The values at the ends of a color's ramp; null if it has no ramp. */
  range(color) {
    return { height: HEIGHTS_M, sweep: [0, this.lastSweep], age: this.ages }[color] ?? null;
  }

  /**
   * Writes the packed colors of all rows.
   *
   * @param {Uint32Array} colors
   * @param {Object} look `color`, `rest`, `isDark`, `ground`, as for `Frame.paint`.
   * @returns {number} The number of rows.
   */
  paint(colors, { color, rest, isDark, ground }) {
    const { sweep, age, dynamic, points } = this.arrays;
    if (color === "dynamic") {
      const pair = [packed(rest), packed(MOVING_COLOR)];
      for (let row = 0; row < this.count; row += 1) colors[row] = pair[dynamic[row] ? 1 : 0];
      return this.count;
    }
    const table = rampTable(isDark);
    const [low, high] = this.range(color);
    const factor = 255 / Math.max(1e-6, high - low);
    const valueOf = {
      height: (row) => points[3 * row + 2] - ground,
      sweep: (row) => sweep[row],
      age: (row) => age[row],
    }[color];
    for (let row = 0; row < this.count; row += 1) {
      colors[row] = table[Math.min(255, Math.max(0, Math.round((valueOf(row) - low) * factor)))];
    }
    return this.count;
  }
}

function rangeOf(values) {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  return low <= high ? [low, high] : [0, 1];
}
