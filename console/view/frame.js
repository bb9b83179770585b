/**
 * A sweep and its flow as arrays to draw: places, motions and colors of points.
 */

import { fullScale, idColor, motionColor, packed, rampTable } from "./colors.js";
import { identity, rigidInverse, transposed } from "./matrix.js";

/** Heights above the ground at the ends of the ramp, metres. */
export const HEIGHTS_M = [-0.5, 4];

/** A place that no camera sees, for rows without a return, metres. */
const NOWHERE_M = -1e7;

/** What colors show, by name, with the reason why one may be missing. */
export const COLORS = {
  residual: { text: "Residual motion", why: "The ego motion of this flow is not known." },
  flow: { text: "Flow", why: "This sweep has no flow." },
  height: { text: "Height", why: "" },
  cluster: { text: "Cluster", why: "This method finds no clusters." },
  confidence: { text: "Confidence", why: "This method gives no confidence." },
  moving: { text: "Chance of motion", why: "This method gives no chance of motion." },
};

/** A sweep, the next one, and the flow between them. */
export class Frame {
  /**
   * @param {Float32Array} source 3N values, metres; NaN in rows without a return.
   * @param {Float32Array|null} target 3M values, in the target's frame.
   * @param {Object|null} pair The flow, as `scene.pair` gives it.
   */
  constructor(source, target, pair) {
    this.source = source;
    this.target = target;
    this.pair = pair;
    this.count = source.length / 3;
    this.position = placed(source);
    this.targetPosition = target ? placed(target) : new Float32Array(0);
    this.ego = pair?.ego ? transposed(pair.ego) : null;
    this.sourceFromTarget = this.ego ? rigidInverse(this.ego) : identity();
    this.flow = pair && motionOf(this.position, pair, this.ego, null);
    this.residual = this.ego && motionOf(this.position, pair, this.ego, this.sourceFromTarget);
    this.scales = new Map();
  }

  /** Whether there is what a color shows. */
  has(color) {
    if (color === "height") return true;
    if (color === "flow") return this.pair !== null;
    return Boolean(color === "residual" ? this.residual : this.pair?.[color]);
  }

  /** The motion of points from time 0 to 1: 3N metres. Null without a flow. */
  motion(isCompensated) {
    return (isCompensated && this.residual) || this.flow;
  }

  /** The motion at which the wheel's colors are full, metres; null for colors that are no motions. */
  scale(color) {
    const motion = { residual: this.residual, flow: this.flow }[color];
    if (!motion) return null;
    if (!this.scales.has(color)) this.scales.set(color, fullScale(motion, this.pair.valid));
    return this.scales.get(color);
  }

  /** The place of a row at a time, metres. */
  place(row, time, isCompensated) {
    const motion = this.motion(isCompensated);
    return [0, 1, 2].map((axis) => this.position[3 * row + axis] + (motion ? time * motion[3 * row + axis] : 0));
  }

  /**
   * Writes the packed colors of all rows; hidden ones get 0.
   *
   * @param {Uint32Array} colors N values, to be written.
   * @param {Object} look `color`, `hasGround`, `confidence` (the least that is shown), `rest` (color
   *   of no motion), `isDark`, `ground` (height, metres).
   * @returns {number} The number of rows that are shown.
   */
  paint(colors, look) {
    const { source, pair, count } = this;
    const colorOf = this.#colorOf(look);
    const cluster = look.hasGround ? null : pair?.cluster;
    const confidence = look.confidence > 0 ? pair?.confidence : null;
    let shown = 0;
    for (let row = 0; row < count; row += 1) {
      const isHidden = Number.isNaN(source[3 * row]) || cluster?.[row] < 0 || confidence?.[row] < look.confidence;
      colors[row] = isHidden ? 0 : colorOf(row);
      if (!isHidden) shown += 1;
    }
    return shown;
  }

  /** A function from a row to its packed color. */
  #colorOf({ color, rest, isDark, ground }) {
    const { source, pair } = this;
    const [gray, faint] = [packed(rest), packed(rest.map((value) => 0.7 * value))];
    const scale = this.scale(color);
    if (scale) {
      const motion = color === "residual" ? this.residual : this.flow;
      return (row) => (pair.valid[row] ? motionColor(motion[3 * row], motion[3 * row + 1], scale, rest) : faint);
    }
    const table = rampTable(isDark);
    const at = (share) => table[Math.min(255, Math.max(0, Math.round(255 * share)))] ?? gray;
    if (color === "cluster" && pair?.cluster) {
      const known = new Map();
      return (row) => {
        const id = pair.cluster[row];
        if (id < 0) return gray;
        if (!known.has(id)) known.set(id, packed(idColor(id, isDark)));
        return known.get(id);
      };
    }
    if (!this.has(color)) return () => gray;
    if (color !== "height") return (row) => at(pair[color][row]);
    const [low, high] = HEIGHTS_M;
    return (row) => at((source[3 * row + 2] - ground - low) / (high - low));
  }
}

/** The points, with those without a return out of sight. */
function placed(points) {
  if (!points.some(Number.isNaN)) return points;
  return points.map((value) => (Number.isNaN(value) ? NOWHERE_M : value));
}

/**
 * The motion of each point: the flow, or what is left of it after `back`, the inverse of the ego
 * motion. Points without a flow move as the static scene does.
 */
function motionOf(position, { flow, valid }, ego, back) {
  const motion = new Float32Array(position.length);
  const still = ego && !back ? ego : identity();
  for (let row = 0; row < valid.length; row += 1) {
    const at = 3 * row;
    const [x, y, z] = [position[at], position[at + 1], position[at + 2]];
    if (!valid[row] || Number.isNaN(flow[at])) {
      if (still === ego) put(motion, at, ego, x, y, z, x, y, z);
    } else if (back) {
      put(motion, at, back, x + flow[at], y + flow[at + 1], z + flow[at + 2], x, y, z);
    } else {
      motion[at] = flow[at];
      motion[at + 1] = flow[at + 1];
      motion[at + 2] = flow[at + 2];
    }
  }
  return motion;
}

/** Writes the way from a place to where `m` leads a point. */
function put(motion, at, m, x, y, z, fromX, fromY, fromZ) {
  motion[at] = m[0] * x + m[4] * y + m[8] * z + m[12] - fromX;
  motion[at + 1] = m[1] * x + m[5] * y + m[9] * z + m[13] - fromY;
  motion[at + 2] = m[2] * x + m[6] * y + m[10] * z + m[14] - fromZ;
}

/**
 * What the picture is fitted to: the height of the ground near the sensor, and a radius about it that
 * holds most points, metres.
 *
 * @param {Float32Array} points 3N values.
 * @returns {{ground: number, radius: number}}
 */
export function extent(points) {
  const heights = [];
  const ranges = [];
  const step = 3 * Math.max(1, Math.floor(points.length / 3 / 20000));
  for (let at = 0; at < points.length; at += step) {
    const range = Math.hypot(points[at], points[at + 1]);
    if (!(range < 300)) continue;
    ranges.push(range);
    if (range > 3 && range < 25) heights.push(points[at + 2]);
  }
  const quantile = (values, share) => values.sort((a, b) => a - b)[Math.floor(share * values.length)];
  return { ground: quantile(heights, 0.12) ?? 0, radius: Math.min(45, Math.max(8, quantile(ranges, 0.85) ?? 40)) };
}
