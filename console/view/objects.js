/**
 * The objects of a sweep: its clusters, or the states of tracks.
 */

import { hue, idColor, mix } from "./colors.js";

/** Farthest that a cluster's center lies from the state of its track, metres. */
const SAME_M = 1.5;

/** Speed from which a direction has a color, m/s. */
const LEAST_SPEED = 0.5;

/**
 * The objects to draw. Tracks take the place of the moving clusters that they follow.
 *
 * @param {Frame} frame
 * @param {Object[]} tracks As `scene.tracks` gives them.
 * @param {number} sweep
 * @param {boolean} isDark Whether the background is dark.
 * @returns {Object[]} `key`, `cluster` (index or null), `id` (of the track or null), `center`, `size`,
 *   `yaw`, `velocity`, `yawRate`, `points`, `confidence`, `moving`, `isMoving`, `isMain` (a track, or a
 *   moving cluster if there are no tracks), `color`.
 */
export function objectsOf(frame, tracks, sweep, isDark) {
  const clusters = (frame.pair?.clusters ?? []).map((cluster, index) => ofCluster(cluster, index, isDark));
  const tracked = tracks.flatMap((track) => {
    const state = track.states.find((state) => state.sweep === sweep);
    return state ? [ofState(track.id, state, clusters, isDark)] : [];
  });
  const taken = new Set(tracked.map((object) => object.cluster));
  const others = clusters.filter((object) => !taken.has(object.cluster));
  return [...tracked, ...others].map((object) => ({
    ...object,
    isMain: object.id !== null || (object.isMoving && tracks.length === 0),
  }));
}

function ofCluster(cluster, index, isDark) {
  return {
    key: `c${index}`,
    cluster: index,
    id: null,
    center: cluster.center,
    size: cluster.size,
    yaw: cluster.yaw,
    velocity: cluster.velocity,
    yawRate: cluster.yaw_rate ?? 0,
    points: cluster.points,
    confidence: cluster.confidence,
    moving: cluster.moving,
    isMoving: Boolean(cluster.dynamic),
    color: colorOf(cluster.velocity, Boolean(cluster.dynamic), isDark),
  };
}

function ofState(id, state, clusters, isDark) {
  const near = clusters
    .map((object) => ({
      object,
      apart: Math.hypot(...[0, 1, 2].map((axis) => object.center[axis] - state.center[axis])),
    }))
    .filter(({ apart }) => apart < Math.max(SAME_M, state.size[0] / 2))
    .sort((a, b) => a.apart - b.apart)[0]?.object;
  return {
    key: `t${id}`,
    cluster: near?.cluster ?? null,
    id,
    center: state.center,
    size: state.size,
    yaw: state.yaw,
    velocity: state.velocity,
    yawRate: state.yaw_rate ?? 0,
    points: state.points,
    confidence: state.confidence,
    moving: near?.moving ?? null,
    isMoving: true,
    color: idColor(id, isDark),
  };
}

/** The wheel's color of a direction, readable on the background. */
function colorOf([x, y], isMoving, isDark) {
  if (!isMoving || Math.hypot(x, y) < LEAST_SPEED) return isDark ? [150, 164, 176] : [104, 116, 126];
  const pure = hue(Math.atan2(y, x) / (2 * Math.PI));
  return isDark ? mix(pure, [255, 255, 255], 0.22) : mix(pure, [0, 0, 0], 0.3);
}

/** Speed of an object, m/s. */
export function speedOf({ velocity }) {
  return Math.hypot(...velocity);
}

/** The short text at an object: its speed, and its id if it has one. */
export function labelOf(object) {
  const speed = `${Math.round(3.6 * speedOf(object))} km/h`;
  return object.id === null ? speed : `#${object.id} · ${speed}`;
}

/**
 * The corners of an object's box at a share of the time to the next sweep: the lower four, then the
 * upper four, counterclockwise from the front left one, metres.
 *
 * @param {Object} object
 * @param {number} seconds Time since the source's.
 * @returns {number[][]} Eight points.
 */
export function cornersOf({ center, size, yaw, velocity, yawRate }, seconds) {
  const turned = yaw + seconds * yawRate;
  const [c, s] = [Math.cos(turned), Math.sin(turned)];
  const [l, w, h] = size.map((value) => value / 2 + 0.06);
  const middle = center.map((value, axis) => value + seconds * velocity[axis]);
  return [-h, h].flatMap((up) =>
    [
      [l, w],
      [-l, w],
      [-l, -w],
      [l, -w],
    ].map(([x, y]) => [middle[0] + c * x - s * y, middle[1] + s * x + c * y, middle[2] + up]),
  );
}

/**
 * The path of a track up to a sweep, in the frame of that sweep.
 *
 * @param {Object[]} states Of a track.
 * @param {number} sweep
 * @param {(sweep: number) => Float32Array|null} toNow The map from the frame of an earlier sweep;
 *   null if it is not known.
 * @param {(matrix: Float32Array, point: number[]) => number[]} transform
 * @returns {number[][]} Centers, metres, the latest last.
 */
export function pathOf(states, sweep, toNow, transform) {
  const path = [];
  const past = states.filter((state) => state.sweep <= sweep).sort((a, b) => b.sweep - a.sweep);
  for (const state of past) {
    const matrix = toNow(state.sweep);
    if (!matrix) break;
    path.unshift(transform(matrix, state.center));
  }
  return path;
}
