/**
 * The boxes of moving objects: of the clusters of a pair, or of the tracks of a sequence.
 */

import { hue, ofId } from "./colors.js";

/** Seconds of motion that the arrow of a box is long. */
const ARROW_SECONDS = 0.5;

/**
 * The moving objects of a sweep.
 *
 * @returns {Array<Object>} Each with `id` (of the track, or null), `cluster` (index or null),
 *   `center`, `size`, `yaw`, `velocity`, `yaw_rate`, `points`, `confidence`, `moving` and `color`.
 */
export function objectsOf(frame, tracks, sweep) {
  const clusters = frame.pair?.clusters ?? [];
  const tracked = tracks.flatMap((track) => {
    const state = track.states.find((state) => state.sweep === sweep);
    return state ? [{ ...state, id: track.id, moving: null, cluster: nearest(clusters, state.center), color: ofId(track.id) }] : [];
  });
  if (tracks.length > 0) return tracked;
  return clusters
    .map((cluster, index) => ({ ...cluster, id: null, cluster: index }))
    .filter((cluster) => cluster.dynamic)
    .map((cluster) => ({ ...cluster, color: hue(cluster.velocity[0], cluster.velocity[1]).map((value) => 255 * value) }));
}

/** The index of the moving cluster at a place. Null if there is none within a metre. */
function nearest(clusters, center) {
  let [best, least] = [null, 1];
  clusters.forEach((cluster, index) => {
    const distance = Math.hypot(...[0, 1, 2].map((axis) => cluster.center[axis] - center[axis]));
    if (cluster.dynamic && distance < least) [best, least] = [index, distance];
  });
  return best;
}

/** The eight corners of an object's box after `seconds`, in the source's frame. */
export function cornersOf({ center, size, yaw, velocity, yaw_rate }, seconds = 0) {
  const turned = yaw + seconds * (yaw_rate ?? 0);
  const [cos, sin] = [Math.cos(turned), Math.sin(turned)];
  const place = center.map((value, axis) => value + seconds * velocity[axis]);
  const corners = [];
  for (const z of [-0.5, 0.5]) {
    for (const [x, y] of [[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]]) {
      const [dx, dy] = [x * size[0], y * size[1]];
      corners.push([place[0] + cos * dx - sin * dy, place[1] + sin * dx + cos * dy, place[2] + z * size[2]]);
    }
  }
  return corners;
}

/** Pairs of corners that edges join. The first four edges are the floor. */
export const EDGES = [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]];

/** The end of an object's arrow. */
export function arrowOf({ center, velocity }) {
  return center.map((value, axis) => value + ARROW_SECONDS * velocity[axis]);
}

/** The speed of an object, m/s. */
export function speedOf({ velocity }) {
  return Math.hypot(velocity[0], velocity[1]);
}

/** The short text of an object's label. */
export function labelOf(object) {
  const speed = `${Math.round(3.6 * speedOf(object))} km/h`;
  return object.id === null ? speed : `#${object.id} ${speed}`;
}
