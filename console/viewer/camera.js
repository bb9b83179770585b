/**
 * A camera that turns about a center.
 */

import { cross, multiply, parallel, perspective, viewFrom } from "./matrix.js";

const FOV = (50 * Math.PI) / 180;
const STEEPEST = Math.PI / 2 - 0.001;
const [NEAREST, FARTHEST] = [0.5, 2000];

/** The views that buttons choose: yaw and pitch of the camera's direction in radians, distance in
 * metres, and the center relative to the sensor on the ground. */
export const VIEWS = {
  free: { yaw: -0.45, pitch: 0.55, distance: 46, center: [10, 0, 0.5], isParallel: false },
  top: { yaw: 0, pitch: STEEPEST, distance: 90, center: [8, 0, 0], isParallel: true },
  side: { yaw: Math.PI / 2, pitch: 0.12, distance: 48, center: [8, 0, 1], isParallel: false },
  driver: { yaw: 0, pitch: 0.16, distance: 24, center: [14, 0, 1.2], isParallel: false },
};

/** The camera. Angles are in radians, lengths in metres; z is up. */
export class Camera {
  constructor() {
    this.groundZ = 0;
    this.set("free");
  }

  /** Takes one of the views of `VIEWS`. */
  set(name) {
    const view = VIEWS[name];
    Object.assign(this, view, { name, center: [view.center[0], view.center[1], view.center[2] + this.groundZ] });
  }

  /** The unit vector in which the camera looks. */
  get forward() {
    const level = Math.cos(this.pitch);
    return [level * Math.cos(this.yaw), level * Math.sin(this.yaw), -Math.sin(this.pitch)];
  }

  get eye() {
    return this.forward.map((value, axis) => this.center[axis] - this.distance * value);
  }

  get #right() {
    return [Math.sin(this.yaw), -Math.cos(this.yaw), 0];
  }

  get #up() {
    return cross(this.#right, this.forward);
  }

  /** The matrix from the scene to the picture. */
  matrix(aspect) {
    const far = this.distance + FARTHEST;
    const projection = this.isParallel
      ? parallel(this.distance, aspect, -FARTHEST, far)
      : perspective(FOV, aspect, Math.max(0.05, this.distance / 200), far);
    return multiply(projection, viewFrom(this.eye, this.forward, this.#up));
  }

  /** Height of the picture at the center, metres. */
  get span() {
    return this.isParallel ? this.distance : 2 * this.distance * Math.tan(FOV / 2);
  }

  /** Turns by angles in radians. */
  turn(yaw, pitch) {
    this.yaw -= yaw;
    this.pitch = Math.min(STEEPEST, Math.max(-0.3, this.pitch + pitch));
    if (this.name !== "top" || this.pitch < STEEPEST) this.name = "free";
    if (this.name === "free") this.isParallel = false;
  }

  /** Moves the center by shares of the picture's height, to the right and up. */
  pan(x, y) {
    const [right, up] = [this.#right, this.#up];
    this.center = this.center.map((value, axis) => value - this.span * (x * right[axis] - y * up[axis]));
  }

  /** Changes the distance by a factor, toward the point at shares of the picture's height from its
   * middle. */
  zoom(factor, x = 0, y = 0) {
    const distance = Math.min(FARTHEST, Math.max(NEAREST, this.distance * factor));
    const change = 1 - distance / this.distance;
    this.pan(-x * change, -y * change);
    this.distance = distance;
  }
}
