/**
 * The arrays of one sweep and its flow, as they are drawn.
 */

import { fullScale, ofId, putMotion, ramp } from "./colors.js";
import { apply, fromRows, identity, inverseRigid } from "./matrix.js";

/** Heights that the ramp covers, metres above the ground. */
const HEIGHTS = [-0.5, 4];

/** The names of the colors of points, with what they need of a pair. */
export const COLORS = {
  residual: { text: "residual motion", needs: (frame) => frame.residual, why: "the ego motion is not known" },
  flow: { text: "flow", needs: (frame) => frame.pair, why: "there is no flow" },
  height: { text: "height", needs: () => true },
  cluster: { text: "cluster", needs: (frame) => frame.pair?.cluster, why: "the method finds no clusters" },
  confidence: { text: "confidence", needs: (frame) => frame.pair?.confidence, why: "the method gives no confidence" },
  moving: { text: "probability of motion", needs: (frame) => frame.pair?.moving, why: "the method gives no probability of motion" },
};

/** The height of the ground: a low quantile of the points' heights near the sensor. */
export function groundHeight(points) {
  const heights = [];
  for (let at = 0; at < points.length; at += 3 * 17) {
    if (Math.hypot(points[at], points[at + 1]) < 25) heights.push(points[at + 2]);
  }
  heights.sort((a, b) => a - b);
  return heights[Math.floor(heights.length / 8)] ?? 0;
}

/** A sweep, the pair that starts at it, and the target of the pair. */
export class Frame {
  /**
   * @param {Float32Array} source 3N values; NaN rows are points without a return.
   * @param {Float32Array|null} target
   * @param {Object|null} pair The flow, as `Scene.pair` gives it.
   */
  constructor(source, target, pair) {
    this.source = source;
    this.target = target;
    this.pair = pair;
    this.count = source.length / 3;
    this.positions = withoutNaN(source);
    this.targetPositions = target && withReturn(target);
    this.ego = pair?.ego ? fromRows(pair.ego) : null;
    this.sourceFromTarget = this.ego ? inverseRigid(this.ego) : identity();
    this.residual = this.ego ? this.#residual() : null;
    this.scales = {};
  }

  /** The motion of each point in the source's frame, ego motion taken out, metres. */
  #residual() {
    const { source, pair, sourceFromTarget: m } = this;
    const residual = new Float32Array(source.length);
    const { flow } = pair;
    for (let at = 0; at < source.length; at += 3) {
      if (!pair.valid[at / 3]) continue;
      const [x, y, z] = [source[at] + flow[at], source[at + 1] + flow[at + 1], source[at + 2] + flow[at + 2]];
      residual[at] = m[0] * x + m[4] * y + m[8] * z + m[12] - source[at];
      residual[at + 1] = m[1] * x + m[5] * y + m[9] * z + m[13] - source[at + 1];
      residual[at + 2] = m[2] * x + m[6] * y + m[10] * z + m[14] - source[at + 2];
    }
    return residual;
  }

  /** The motion that is drawn: of the points alone, or with the ego motion. Null without a flow. */
  motions(isCompensated) {
    if (!this.pair) return null;
    return isCompensated && this.residual ? this.residual : this.pair.flow;
  }

  /** The frame in which the target is drawn beside the moved source. */
  targetFrame(isCompensated) {
    return isCompensated && this.ego ? this.sourceFromTarget : identity();
  }

  /** The color that is drawn where `color` is chosen: the height where the sweep lacks what it needs. */
  shownColor(color) {
    return COLORS[color].needs(this) ? color : "height";
  }

  /** Full scale of a motion color, metres. */
  scale(color) {
    if (color !== "residual" && color !== "flow") return null;
    const motion = color === "residual" ? this.residual : this.pair?.flow;
    if (!motion) return null;
    this.scales[color] ??= fullScale(motion, this.pair.valid);
    return this.scales[color];
  }

  /**
   * The colors of the points, with alpha 0 for those that are hidden.
   *
   * @returns {{colors: Uint8Array, shown: number}} 4N bytes, and the number of points that are shown.
   */
  colors({ color, showsGround, confidence, rest, groundZ }) {
    const { source, pair, count } = this;
    const colors = new Uint8Array(4 * count);
    const put = this.#painter(color, rest, groundZ);
    let shown = 0;
    for (let row = 0; row < count; row += 1) {
      if (Number.isNaN(source[3 * row])) continue;
      if (pair?.cluster && !showsGround && pair.cluster[row] < 0) continue;
      if (pair?.confidence && pair.confidence[row] < confidence) continue;
      put(colors, 4 * row, row);
      colors[4 * row + 3] = 255;
      shown += 1;
    }
    return { colors, shown };
  }

  /** A function that writes the color of a row. */
  #painter(color, rest, groundZ) {
    const { source, pair } = this;
    const fill = (out, at, [red, green, blue]) => {
      out[at] = red;
      out[at + 1] = green;
      out[at + 2] = blue;
    };
    const scale = this.scale(color);
    if (scale) {
      const motion = color === "residual" ? this.residual : pair.flow;
      return (out, at, row) => {
        if (pair.valid[row]) putMotion(out, at, motion[3 * row], motion[3 * row + 1], scale, rest);
        else fill(out, at, rest.map((value) => 0.6 * value));
      };
    }
    if (color === "cluster" && pair?.cluster) {
      return (out, at, row) => fill(out, at, pair.cluster[row] < 0 ? rest : ofId(pair.cluster[row] + 1));
    }
    if ((color === "confidence" || color === "moving") && pair?.[color]) {
      const values = pair[color];
      return (out, at, row) => fill(out, at, pair.valid[row] ? ramp(values[row]) : rest);
    }
    const [low, high] = HEIGHTS;
    return (out, at, row) => fill(out, at, ramp((source[3 * row + 2] - groundZ - low) / (high - low)));
  }

  /** The place of a source point at a time, in the drawn frame. */
  place(row, time, isCompensated) {
    const motion = this.motions(isCompensated);
    return [0, 1, 2].map((axis) => this.positions[3 * row + axis] + (motion ? time * motion[3 * row + axis] : 0));
  }

  /** The place of a point of the source's frame that moves to `moved` (also there), at a time. */
  placeOf(point, moved, time, isCompensated) {
    const end = isCompensated || !this.ego ? moved : apply(this.ego, moved);
    return point.map((value, axis) => value + time * (end[axis] - value));
  }
}

/** The points with zeros in rows without a return. The same array if there are none. */
function withoutNaN(points) {
  if (!points.some(Number.isNaN)) return points;
  return points.map((value) => (Number.isNaN(value) ? 0 : value));
}

/** The points without the rows that have no return. */
function withReturn(points) {
  return points.some(Number.isNaN) ? points.filter((_, at) => !Number.isNaN(points[at - (at % 3)])) : points;
}

/** A dense cloud, as it is drawn. */
export class DenseFrame {
  constructor(dense) {
    this.dense = dense;
    this.count = dense.points.length / 3;
    this.positions = dense.points;
  }

  /** The colors of the points: by `height`, `sweep` or `dynamic`. */
  colors(color, rest, groundZ) {
    const { points, sweep, dynamic } = this.dense;
    const colors = new Uint8Array(4 * this.count);
    const last = Math.max(1, sweep.reduce((most, value) => Math.max(most, value), 0));
    const [low, high] = HEIGHTS;
    const ofRow = {
      height: (row) => ramp((points[3 * row + 2] - groundZ - low) / (high - low)),
      sweep: (row) => ramp(sweep[row] / last),
      dynamic: (row) => (dynamic[row] ? [255, 140, 60] : rest),
    }[color];
    for (let row = 0; row < this.count; row += 1) {
      const [red, green, blue] = ofRow(row);
      colors[4 * row] = red;
      colors[4 * row + 1] = green;
      colors[4 * row + 2] = blue;
      colors[4 * row + 3] = 255;
    }
    return colors;
  }

  /** The place of a point. */
  place(row) {
    return Array.from(this.positions.subarray(3 * row, 3 * row + 3));
  }
}
