/**
 * Finds what lies under the pointer.
 */

import { project } from "./matrix.js";
import { EDGES } from "./segments.js";

/** Distance in the picture up to which a point or an edge is hit, pixels. */
export const REACH_PX = 8;

/** Pixels that a point e times as far away has to be nearer to the pointer, to be preferred. */
const DEPTH_PX = 14;

/** Weight of the depth in clip space where the view is parallel. */
const PARALLEL = 10;

/**
 * The drawn point at the pointer. Nearer points come first among those within reach.
 *
 * @param {Object} cloud `position` (3N metres), `motion` (3N metres or null), `time`, `color` (N
 *   packed colors, 0 is hidden; null: all are shown), `view` (matrix to clip space).
 * @param {{x: number, y: number}} pointer Pixels.
 * @param {{width: number, height: number}} size Of the picture, pixels.
 * @returns {{row: number, apart: number, score: number}|null} `apart` in pixels; the least score is
 *   the best.
 */
export function pickPoint({ position, motion, time, color, view: m }, pointer, { width, height }) {
  const [aimX, aimY] = [(2 * pointer.x) / width - 1, 1 - (2 * pointer.y) / height];
  const [scaleX, scaleY] = [width / 2, height / 2];
  const step = motion ? time : 0;
  const isParallel = m[3] === 0 && m[7] === 0 && m[11] === 0;
  let best = null;
  for (let row = 0, at = 0; at < position.length; row += 1, at += 3) {
    if (color && color[row] === 0) continue;
    let [x, y, z] = [position[at], position[at + 1], position[at + 2]];
    if (step > 0) {
      x += step * motion[at];
      y += step * motion[at + 1];
      z += step * motion[at + 2];
    }
    const depth = m[3] * x + m[7] * y + m[11] * z + m[15];
    if (depth < 0.05) continue;
    const right = ((m[0] * x + m[4] * y + m[8] * z + m[12]) / depth - aimX) * scaleX;
    if (right > REACH_PX || right < -REACH_PX) continue;
    const up = ((m[1] * x + m[5] * y + m[9] * z + m[13]) / depth - aimY) * scaleY;
    const apart = Math.hypot(right, up);
    if (apart > REACH_PX) continue;
    const far = isParallel ? PARALLEL * (m[2] * x + m[6] * y + m[10] * z + m[14]) : Math.log(depth);
    const score = apart + DEPTH_PX * far;
    if (!best || score < best.score) best = { row, apart, score };
  }
  return best;
}

/**
 * The object an edge of whose box is at the pointer.
 *
 * @param {{object: Object, corners: number[][]}[]} boxes As they are drawn.
 * @param {Float32Array} view
 * @returns {{object: Object, apart: number}|null}
 */
export function pickEdge(boxes, view, pointer, size) {
  let best = null;
  for (const { object, corners } of boxes) {
    const places = corners.map((corner) => project(view, corner, size));
    if (places.some(({ depth }) => depth <= 0)) continue;
    for (const [from, to] of EDGES) {
      const apart = distanceToSegment(pointer, places[from], places[to]);
      if (apart <= REACH_PX && (!best || apart < best.apart)) best = { object, apart };
    }
  }
  return best;
}

/**
 * The smallest object whose outline in the picture holds the pointer.
 *
 * @returns {Object|null}
 */
export function pickInside(boxes, view, pointer, size) {
  let best = null;
  for (const { object, corners } of boxes) {
    const places = corners.map((corner) => project(view, corner, size));
    if (places.some(({ depth }) => depth <= 0)) continue;
    const faces = [
      [0, 1, 2, 3],
      [4, 5, 6, 7],
      [0, 1, 5, 4],
      [1, 2, 6, 5],
      [2, 3, 7, 6],
      [3, 0, 4, 7],
    ];
    if (
      !faces.some((face) =>
        holds(
          face.map((corner) => places[corner]),
          pointer,
        ),
      )
    )
      continue;
    const volume = object.size[0] * object.size[1] * object.size[2];
    if (!best || volume < best.volume) best = { object, volume };
  }
  return best?.object ?? null;
}

function distanceToSegment({ x, y }, from, to) {
  const [dx, dy] = [to.x - from.x, to.y - from.y];
  const share = Math.min(1, Math.max(0, ((x - from.x) * dx + (y - from.y) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - from.x - share * dx, y - from.y - share * dy);
}

/** Whether a convex outline holds a place. */
function holds(outline, { x, y }) {
  const signs = outline.map((from, at) => {
    const to = outline[(at + 1) % outline.length];
    return Math.sign((to.x - from.x) * (y - from.y) - (to.y - from.y) * (x - from.x));
  });
  return signs.every((sign) => sign >= 0) || signs.every((sign) => sign <= 0);
}
