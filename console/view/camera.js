/**
 * The camera: it turns about a focus, z is up. Lengths in metres, angles in radians.
 */

import { multiply } from "./matrix.js";

const FIELD_OF_VIEW = (46 * Math.PI) / 180;
const HALF_HEIGHT = Math.tan(FIELD_OF_VIEW / 2);
/** How far the width decides in pictures that are higher than wide: 0 not at all, 1 alone. */
const NARROWNESS = 0.75;
const STEEPEST = Math.PI / 2 - 1e-3;
const FLATTEST = -0.35;
const NEAREST_M = 0.6;
const FARTHEST_M = 1500;
/** Depth that is drawn beyond the focus, metres. */
const REACH_M = 2500;

/** The presets. `yaw` is the direction in which the camera looks, `pitch` how far down; `focus` is
 * relative to the sensor's place on the ground, and `distance` counts in radii of the scene. */
export const PRESETS = {
  free: { yaw: -0.45, pitch: 0.46, distance: 1.05, focus: [11, -1, 0], isParallel: false },
  top: { yaw: 0, pitch: STEEPEST, distance: 2.5, focus: [6, 0, 0], isParallel: true },
  side: { yaw: Math.PI / 2, pitch: 0.14, distance: 1.2, focus: [6, 0, 1.5], isParallel: false },
  driver: { yaw: 0, pitch: 0.17, distance: 0.5, focus: [11, 0, 1.5], isParallel: false },
};

/** A camera. After its fields are changed the picture has to be drawn again. */
export class Camera {
  /** Radius of the scene, metres: distances of presets follow it. */
  radius = 40;
  /** Height of the ground, metres. */
  ground = 0;
  /** Width over height of the picture. */
  aspect = 1;

  constructor() {
    this.choose("free");
  }

  /**
   * Takes a preset.
   *
   * @param {"free"|"top"|"side"|"driver"} name
   */
  choose(name) {
    const { yaw, pitch, distance, focus, isParallel } = PRESETS[name];
    this.name = name;
    this.yaw = yaw;
    this.pitch = pitch;
    this.isParallel = isParallel;
    this.distance = distance * this.radius;
    this.focus = [focus[0], focus[1], focus[2] + this.ground];
  }

  /** Unit vectors of the picture: to the right, up, and into it. */
  axes() {
    const [s, c] = [Math.sin(this.yaw), Math.cos(this.yaw)];
    const [down, level] = [Math.sin(this.pitch), Math.cos(this.pitch)];
    return { right: [s, -c, 0], up: [down * c, down * s, level], forward: [level * c, level * s, -down] };
  }

  /** Half the picture's height at distance 1. Narrow pictures show more above and below. */
  get #half() {
    return HALF_HEIGHT * Math.max(1, this.aspect ** -NARROWNESS);
  }

  /** Height of the picture at the focus, metres. */
  get span() {
    return 2 * this.distance * this.#half;
  }

  /** Pixels per metre times depth, for a picture of `height` pixels. */
  pixelsPerMetre(height) {
    return this.isParallel ? height / this.span : height / (2 * this.#half);
  }

  /**
   * The matrix from the scene to clip space.
   *
   * @param {number} aspect Width over height of the picture.
   * @returns {Float32Array}
   */
  matrix(aspect) {
    this.aspect = aspect;
    return multiply(this.#projection(aspect), this.#view());
  }

  #view() {
    const { right, up, forward } = this.axes();
    const eye = this.focus.map((value, axis) => value - this.distance * forward[axis]);
    const along = (axis) => axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2];
    const view = new Float32Array(16);
    for (let axis = 0; axis < 3; axis += 1) {
      view[4 * axis] = right[axis];
      view[4 * axis + 1] = up[axis];
      view[4 * axis + 2] = -forward[axis];
    }
    view.set([-along(right), -along(up), along(forward), 1], 12);
    return view;
  }

  #projection(aspect) {
    const far = this.distance + REACH_M;
    const matrix = new Float32Array(16);
    if (this.isParallel) {
      matrix[0] = 2 / (this.span * aspect);
      matrix[5] = 2 / this.span;
      matrix[10] = -1 / far;
      matrix[15] = 1;
      return matrix;
    }
    const near = Math.max(0.1, this.distance / 150);
    matrix[0] = 1 / (this.#half * aspect);
    matrix[5] = 1 / this.#half;
    matrix[10] = (near + far) / (near - far);
    matrix[11] = -1;
    matrix[14] = (2 * near * far) / (near - far);
    return matrix;
  }

  /** Turns to the left and down. A camera that was turned is free. */
  turn(left, down) {
    this.yaw += left;
    this.pitch = Math.min(STEEPEST, Math.max(FLATTEST, this.pitch + down));
    if (this.name === "top" && this.pitch === STEEPEST) return;
    this.name = "free";
    this.isParallel = false;
  }

  /** Moves the focus, as shares of the picture's height to the right and down. */
  pan(right, down) {
    const axes = this.axes();
    this.focus = this.focus.map((value, axis) => value - this.span * (right * axes.right[axis] - down * axes.up[axis]));
  }

  /**
   * Changes the distance. What lies in the focus' plane at a place of the picture stays there.
   *
   * @param {number} factor Of the distance; below 1 the camera comes nearer.
   * @param {number} [right] The place, as shares of the picture's height from its middle.
   * @param {number} [down]
   */
  zoom(factor, right = 0, down = 0) {
    const distance = Math.min(FARTHEST_M, Math.max(NEAREST_M, factor * this.distance));
    const change = distance / this.distance - 1;
    this.pan(change * right, change * down);
    this.distance = distance;
  }
}
