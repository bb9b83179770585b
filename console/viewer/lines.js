/**
 * Lines of the scene: grid, axes, boxes, arrows, trajectories and the measured distance.
 */

import { apply, fromRows } from "./matrix.js";
import { arrowOf, cornersOf, EDGES } from "./objects.js";

/** Distances of the rings about the sensor, metres. */
const RINGS = [10, 20, 30, 40, 50];

/** Number of past states that a trajectory shows. */
const PAST = 40;

/** Line segments with colors. */
export class Lines {
  starts = [];
  ends = [];
  colors = [];

  /** Adds a segment. `color` is 0 to 255, `alpha` 0 to 1. */
  add(from, to, color, alpha = 1) {
    this.starts.push(...from);
    this.ends.push(...to);
    this.colors.push(color[0], color[1], color[2], 255 * alpha);
  }
}

/** Rings on the ground, and the axes of the sensor's frame: x red, y green, z blue. */
export function addGrid(lines, groundZ, color) {
  for (const radius of RINGS) {
    const parts = 72;
    const at = (part) => {
      const angle = (2 * Math.PI * part) / parts;
      return [radius * Math.cos(angle), radius * Math.sin(angle), groundZ];
    };
    for (let part = 0; part < parts; part += 1) lines.add(at(part), at(part + 1), color, 0.35);
  }
  const last = RINGS.at(-1);
  lines.add([-last, 0, groundZ], [last, 0, groundZ], color, 0.25);
  lines.add([0, -last, groundZ], [0, last, groundZ], color, 0.25);
  lines.add([0, 0, groundZ], [2, 0, groundZ], [230, 70, 70]);
  lines.add([0, 0, groundZ], [0, 2, groundZ], [60, 170, 90]);
  lines.add([0, 0, groundZ], [0, 0, groundZ + 2], [80, 120, 240]);
}

/** The box of an object at a time with its arrow. */
export function addObject(lines, object, frame, time, isCompensated, isPicked) {
  const dt = frame.pair?.dt ?? 0;
  const moved = cornersOf(object, dt);
  const corners = cornersOf(object).map((corner, index) => frame.placeOf(corner, moved[index], time, isCompensated));
  const color = isPicked ? [255, 255, 255] : object.color;
  for (const [from, to] of EDGES) lines.add(corners[from], corners[to], color);
  const shift = (point) => point.map((value, axis) => value + dt * object.velocity[axis]);
  const [from, to] = [object.center, arrowOf(object)].map((point) => frame.placeOf(point, shift(point), time, isCompensated));
  lines.add(from, to, color);
  const back = [0, 1].map((axis) => to[axis] - from[axis]);
  const length = Math.hypot(...back);
  if (length < 0.2) return;
  const head = Math.min(0.8, 0.3 * length) / length;
  for (const side of [-0.5, 0.5]) {
    const tip = [to[0] - head * (back[0] - side * back[1]), to[1] - head * (back[1] + side * back[0]), to[2]];
    lines.add(to, tip, color);
  }
}

/**
 * The past centers of the tracks that the sweep shows, in its frame.
 *
 * @param {(sweep: number) => ArrayLike<number>|null} egoOf The ego motion from a sweep to the next,
 *   row by row.
 */
export function addTrajectories(lines, objects, tracks, sweep, egoOf) {
  const poses = new Map([[sweep, null]]);
  let pose = null;
  for (let past = sweep - 1; past >= Math.max(0, sweep - PAST); past -= 1) {
    const rows = egoOf(past);
    if (!rows) break;
    const step = fromRows(rows);
    const before = pose;
    pose = before === null ? (point) => apply(step, point) : (point) => before(apply(step, point));
    poses.set(past, pose);
  }
  for (const object of objects) {
    // Objects that were made before the tracks came have no track.
    const track = tracks.find(({ id }) => id === object.id);
    if (!track) continue;
    const past = track.states.filter((state) => state.sweep <= sweep && poses.has(state.sweep));
    const places = past.map((state) => poses.get(state.sweep)?.(state.center) ?? state.center);
    for (let index = 1; index < places.length; index += 1) lines.add(places[index - 1], places[index], object.color, 0.8);
  }
}
