/**
 * Segments of lines, as they are written to the graphics card, and the figures made of them.
 */

import { cornersOf, speedOf } from "./objects.js";

const WORDS = 7;

/** Time in which an object goes the length of its arrow, seconds. */
const ARROW_S = 1;

/** Distance between the rings about the sensor, and the last one, metres. */
const RING_M = 10;
const LAST_RING_M = 100;

/** The edges of a box, by the corners of `cornersOf`. */
export const EDGES = [
  [0, 1],
  [1, 2],
  [2, 3],
  [3, 0],
  [4, 5],
  [5, 6],
  [6, 7],
  [7, 4],
  [0, 4],
  [1, 5],
  [2, 6],
  [3, 7],
];

/** A growing list of segments. */
export class Segments {
  #words = new Float32Array(WORDS * 512);
  #colors = new Uint8Array(this.#words.buffer);
  count = 0;

  /** Begins anew. */
  clear() {
    this.count = 0;
  }

  /** What is there, 28 bytes a segment. */
  get bytes() {
    return this.#colors.subarray(0, 4 * WORDS * this.count);
  }

  /** Adds a segment. `alpha` is 0 to 1. */
  add(start, end, [red, green, blue], alpha = 1) {
    const at = WORDS * this.count;
    if (at + WORDS > this.#words.length) this.#grow();
    this.#words.set(start, at);
    this.#words.set(end, at + 3);
    this.#colors.set([red, green, blue, 255 * alpha], 4 * (at + 6));
    this.count += 1;
  }

  #grow() {
    const words = new Float32Array(2 * this.#words.length);
    words.set(this.#words);
    this.#words = words;
    this.#colors = new Uint8Array(words.buffer);
  }
}

/** Adds the rings on the ground and the axes of the sensor's frame. */
export function addGrid(segments, ground, color) {
  for (let radius = RING_M; radius <= LAST_RING_M; radius += RING_M) {
    const parts = 48 + radius;
    const at = (part) => {
      const angle = (2 * Math.PI * part) / parts;
      return [radius * Math.cos(angle), radius * Math.sin(angle), ground];
    };
    const alpha = radius % 50 === 0 ? 0.55 : 0.3;
    for (let part = 0; part < parts; part += 1) segments.add(at(part), at(part + 1), color, alpha);
  }
  for (const [x, y] of [
    [1, 0],
    [-1, 0],
    [0, 1],
    [0, -1],
  ]) {
    segments.add([2 * x, 2 * y, ground], [LAST_RING_M * x, LAST_RING_M * y, ground], color, 0.22);
  }
  const axes = [
    [
      [2, 0, 0],
      [235, 87, 87],
    ],
    [
      [0, 2, 0],
      [70, 180, 100],
    ],
    [
      [0, 0, 2],
      [80, 140, 245],
    ],
  ];
  const origin = [0, 0, ground];
  for (const [axis, own] of axes) segments.add(origin, [axis[0], axis[1], ground + axis[2]], own);
}

/** Places and texts of the rings' labels. */
export function ringLabels(ground) {
  return [10, 20, 30, 50, 100].map((radius) => ({ place: [radius, 0, ground], text: `${radius} m` }));
}

/** Adds a box. `lead` maps its corners to the drawn frame. */
export function addBox(segments, object, seconds, lead, alpha) {
  const corners = cornersOf(object, seconds).map(lead);
  for (const [from, to] of EDGES) segments.add(corners[from], corners[to], object.color, alpha);
  return corners;
}

/** Adds the arrow of an object's velocity: where it is a second later. */
export function addArrow(segments, object, seconds, lead) {
  const speed = speedOf(object);
  if (speed < 0.3) return;
  const { center, velocity } = object;
  const at = (time, side = 0) => {
    const level = Math.hypot(velocity[0], velocity[1]) || 1;
    const across = [(-side * velocity[1]) / level, (side * velocity[0]) / level, 0];
    return lead(center.map((value, axis) => value + time * velocity[axis] + across[axis]));
  };
  const end = seconds + ARROW_S;
  const head = Math.min(0.35 * ARROW_S, 0.9 / speed);
  segments.add(at(seconds), at(end), object.color);
  segments.add(at(end), at(end - head, 0.5 * head * speed), object.color);
  segments.add(at(end), at(end - head, -0.5 * head * speed), object.color);
}

/** Adds a path that is fainter in the past. */
export function addPath(segments, places, color) {
  for (let at = 1; at < places.length; at += 1) {
    segments.add(places[at - 1], places[at], color, 0.35 + (0.65 * at) / places.length);
  }
}
