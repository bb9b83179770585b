/**
 * Pointer, wheel and keyboard on the canvas.
 */

/** Way of the pointer up to which a press is a click, pixels. */
const CLICK_PX = 5;

/** Turn for the way of a picture's height, radians. */
const TURN = 2.6;

/**
 * Listens on the canvas.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {Object} to `camera`, `moved()`, `clicked(x, y)` in pixels, and `pressed(event)` for keys,
 *   which returns whether the key was used.
 * @param {AbortSignal} signal Ends the listeners.
 */
export function listenTo(canvas, to, signal) {
  const on = (name, listener) => canvas.addEventListener(name, listener, { signal, passive: false });
  const pointers = new Pointers(canvas, to);
  on("contextmenu", (event) => event.preventDefault());
  on("pointerdown", (event) => pointers.down(event));
  on("pointermove", (event) => pointers.move(event));
  on("pointerup", (event) => pointers.up(event));
  on("pointercancel", (event) => pointers.cancel(event));
  on("wheel", (event) => {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 20 : 1);
    const { clientWidth: width, clientHeight: height } = canvas;
    const factor = Math.exp(0.0013 * Math.min(300, Math.max(-300, pixels)));
    to.camera.zoom(factor, (event.offsetX - width / 2) / height, (event.offsetY - height / 2) / height);
    to.moved();
  });
  on("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (to.pressed(event)) event.preventDefault();
  });
}

/** The pointers that are down: one turns, or moves with shift or the right button; two zoom. */
class Pointers {
  #places = new Map();
  #way = 0;
  #wasPinch = false;

  constructor(canvas, to) {
    this.canvas = canvas;
    this.to = to;
  }

  down(event) {
    if (event.isTrusted) this.canvas.setPointerCapture(event.pointerId);
    this.#places.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.#places.size > 1) this.#wasPinch = true;
    else [this.#way, this.#wasPinch] = [0, false];
  }

  move(event) {
    const before = this.#places.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    const [right, down] = [now[0] - before[0], now[1] - before[1]].map((pixels) => pixels / this.canvas.clientHeight);
    this.#way += Math.hypot(now[0] - before[0], now[1] - before[1]);
    this.#places.set(event.pointerId, now);
    if (this.#way < CLICK_PX) return;
    const { camera } = this.to;
    if (this.#places.size > 1) this.#pinch(event.pointerId, before, now);
    else if (event.shiftKey || event.buttons === 2 || event.buttons === 4) camera.pan(right, down);
    else camera.turn(-TURN * right, TURN * down);
    this.to.moved();
  }

  /** Zooms about the middle of two pointers, and moves with it. */
  #pinch(id, before, now) {
    const other = [...this.#places].find(([known]) => known !== id)[1];
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { left, top } = this.canvas.getBoundingClientRect();
    const apart = (place) => Math.max(8, Math.hypot(place[0] - other[0], place[1] - other[1]));
    const middle = [(now[0] + other[0]) / 2 - left, (now[1] + other[1]) / 2 - top];
    const { camera } = this.to;
    camera.zoom(apart(before) / apart(now), (middle[0] - width / 2) / height, (middle[1] - height / 2) / height);
    camera.pan((now[0] - before[0]) / 2 / height, (now[1] - before[1]) / 2 / height);
  }

  up(event) {
    if (!this.#places.delete(event.pointerId)) return;
    const isClick = this.#way < CLICK_PX && !this.#wasPinch && event.button === 0 && !event.shiftKey;
    if (!isClick) return;
    const { left, top } = this.canvas.getBoundingClientRect();
    this.to.clicked(event.clientX - left, event.clientY - top);
  }

  cancel(event) {
    this.#places.delete(event.pointerId);
  }
}
