/**
 * The legend of a color: the wheel of directions, or a ramp with numbers.
 */

import { el, fill } from "../dom.js";
import { COLORS } from "./frame.js";
import { putMotion, ramp } from "./colors.js";

const SIZE = 96;

/** Numbers at the ends of the ramps. */
const ENDS = {
  height: ["-0.5 m", "4 m"],
  confidence: ["0", "1"],
  moving: ["0", "1"],
  sweep: ["first", "last"],
};

/** Fills `element` with the legend of `color`. `scale` is the full scale in metres, `dt` in seconds. */
export function showLegend(element, color, scale, dt, rest) {
  element.hidden = !color;
  const name = COLORS[color]?.text ?? { sweep: "sweep", dynamic: "moving points" }[color];
  const title = el("p", { class: "fv-title" }, `Color: ${name}`);
  if (scale) fill(element, title, wheel(rest), el("p", {}, `full color from ${Number(scale.toPrecision(2))} m`, el("br"), `${(scale / dt).toFixed(1)} m/s`));
  else if (ENDS[color]) fill(element, title, bar(), el("p", { class: "fv-ends" }, ENDS[color].map((end) => el("span", {}, end))));
  else fill(element, title);
}

/** The wheel: the color of a motion to the right of the picture is that of +x, which is forward. */
function wheel(rest) {
  const canvas = el("canvas", { width: SIZE, height: SIZE, class: "fv-wheel", role: "img", "aria-label": "Wheel of directions: forward is up" });
  const context = canvas.getContext("2d");
  const image = context.createImageData(SIZE, SIZE);
  const middle = (SIZE - 1) / 2;
  for (let row = 0; row < SIZE; row += 1) {
    for (let column = 0; column < SIZE; column += 1) {
      // Forward, +x, is up, and left, +y, is left.
      const [x, y] = [(middle - row) / middle, (middle - column) / middle];
      if (Math.hypot(x, y) > 1) continue;
      const at = 4 * (row * SIZE + column);
      putMotion(image.data, at, x, y, 1, rest);
      image.data[at + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

function bar() {
  const canvas = el("canvas", { width: 160, height: 10, class: "fv-bar", role: "img", "aria-label": "Ramp from low to high" });
  const context = canvas.getContext("2d");
  for (let column = 0; column < 160; column += 1) {
    context.fillStyle = `rgb(${ramp(column / 159).map(Math.round).join(" ")})`;
    context.fillRect(column, 0, 1, 10);
  }
  return canvas;
}
