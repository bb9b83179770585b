/**
 * Finds the ground of a target sweep, which has no clusters of its own, from that of the source.
 */

/** Edge of a cell, metres. */
const CELL_M = 2;

/** Half the side of the square of cells, metres, and the number of cells along it. */
const REACH_M = 250;
const CELLS = (2 * REACH_M) / CELL_M;

/** Height above a cell's lowest point up to which points count as ground, metres. */
const ABOVE_M = 0.4;

/**
 * Marks target points near the places to which source points of no cluster move.
 *
 * @param {Frame} frame A frame with clusters and a target.
 * @returns {Uint32Array} A packed color for each target row: 0 for ground, else white.
 */
export function withoutGround({ position, flow, targetPosition, pair }) {
  const lowest = new Float32Array(CELLS * CELLS).fill(Infinity);
  for (let row = 0; row < pair.cluster.length; row += 1) {
    if (pair.cluster[row] >= 0) continue;
    const at = 3 * row;
    const cell = cellOf(position[at] + flow[at], position[at + 1] + flow[at + 1]);
    if (cell >= 0) lowest[cell] = Math.min(lowest[cell], position[at + 2] + flow[at + 2]);
  }
  const colors = new Uint32Array(targetPosition.length / 3);
  for (let row = 0; row < colors.length; row += 1) {
    const at = 3 * row;
    const cell = cellOf(targetPosition[at], targetPosition[at + 1]);
    const isGround = cell >= 0 && targetPosition[at + 2] - ABOVE_M < lowest[cell] && lowest[cell] < Infinity;
    colors[row] = isGround ? 0 : 0xffffffff;
  }
  return colors;
}

/** The index of the cell of a place; negative outside. */
function cellOf(x, y) {
  const [column, line] = [Math.floor((x + REACH_M) / CELL_M), Math.floor((y + REACH_M) / CELL_M)];
  return column >= 0 && line >= 0 && column < CELLS && line < CELLS ? line * CELLS + column : -1;
}
