/**
 * Finds the point under the pointer.
 */

/** Largest distance of a picked point from the pointer, pixels. */
const REACH = 9;

/**
 * The visible point nearest to the camera among those near the pointer.
 *
 * @param {Object} cloud `positions` and, if points move, `motions` (3N values), `colors` (4N bytes;
 *   alpha 0 is hidden) and `time`.
 * @param {Float32Array} view The camera's matrix.
 * @param {{x: number, y: number, width: number, height: number}} pointer In pixels.
 * @returns {number|null} The row.
 */
export function pick({ positions, motions, colors, time }, view, pointer) {
  let [best, nearest] = [null, Infinity];
  for (let row = 0; row < positions.length / 3; row += 1) {
    if (colors[4 * row + 3] === 0) continue;
    const at = 3 * row;
    let [x, y, z] = [positions[at], positions[at + 1], positions[at + 2]];
    if (motions) {
      x += time * motions[at];
      y += time * motions[at + 1];
      z += time * motions[at + 2];
    }
    const w = view[3] * x + view[7] * y + view[11] * z + view[15];
    if (w <= 0) continue;
    const dx = (0.5 + (0.5 * (view[0] * x + view[4] * y + view[8] * z + view[12])) / w) * pointer.width - pointer.x;
    if (Math.abs(dx) > REACH) continue;
    const dy = (0.5 - (0.5 * (view[1] * x + view[5] * y + view[9] * z + view[13])) / w) * pointer.height - pointer.y;
    const depth = (view[2] * x + view[6] * y + view[10] * z + view[14]) / w;
    const away = Math.hypot(dx, dy);
    // A point a little behind, but nearer to the pointer, is meant.
    const rank = depth * 1000 + away;
    if (away <= REACH && rank < nearest) [best, nearest] = [row, rank];
  }
  return best;
}
