/**
 * Pointer, wheel and keys on the canvas.
 */

/** Movement up to which a press counts as a click, pixels. */
const STILL = 4;

/**
 * Connects the canvas. `actions` has `camera` (the camera), `moved()`, `clicked(x, y)` and
 * `key(key)`, which returns whether it knows the key.
 *
 * @param {AbortSignal} signal Ends all listeners.
 */
export function listen(canvas, actions, signal) {
  const fingers = new Map();
  let travel = 0;
  const on = (event, listener, options = {}) => canvas.addEventListener(event, listener, { signal, ...options });
  const height = () => canvas.clientHeight;
  on("contextmenu", (event) => event.preventDefault());
  on("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    travel = 0;
  });
  on("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY];
    const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
    travel += Math.hypot(dx, dy);
    if (fingers.size === 2) pinch(fingers, event.pointerId, now, actions.camera, height());
    else if (event.shiftKey || event.buttons === 2) actions.camera.pan(dx / height(), dy / height());
    else actions.camera.turn((2.5 * dx) / height(), (2.5 * dy) / height());
    fingers.set(event.pointerId, now);
    actions.moved();
  });
  on("pointerup", (event) => {
    const wasAlone = fingers.size === 1;
    fingers.delete(event.pointerId);
    if (wasAlone && travel < STILL && event.button === 0) actions.clicked(event.offsetX, event.offsetY);
  });
  on("pointercancel", (event) => fingers.delete(event.pointerId));
  on("wheel", (event) => {
    event.preventDefault();
    const x = (event.offsetX - canvas.clientWidth / 2) / height();
    const y = (event.offsetY - height() / 2) / height();
    actions.camera.zoom(Math.exp(0.0012 * event.deltaY), x, y);
    actions.moved();
  }, { passive: false });
  on("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (actions.key(event.key)) event.preventDefault();
  });
}

/** Moves and zooms by two fingers. */
function pinch(fingers, moving, now, camera, height) {
  const [other] = [...fingers].filter(([id]) => id !== moving).map(([, place]) => place);
  const before = fingers.get(moving);
  const distance = (place) => Math.max(1, Math.hypot(place[0] - other[0], place[1] - other[1]));
  camera.zoom(distance(before) / distance(now));
  camera.pan((now[0] - before[0]) / (2 * height), (now[1] - before[1]) / (2 * height));
}
