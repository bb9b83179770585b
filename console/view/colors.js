/**
 * Colors: the wheel of motions, ramps of values, and distinct colors of ids. Channels are 0 to 255.
 */

/** Steps of the Middlebury wheel: red, yellow, green, cyan, blue, magenta and back to red. */
const WHEEL = [
  [15, [255, 0, 0]],
  [6, [255, 255, 0]],
  [4, [0, 255, 0]],
  [11, [0, 255, 255]],
  [13, [0, 0, 255]],
  [6, [255, 0, 255]],
];
const STEPS = WHEEL.reduce((sum, [steps]) => sum + steps, 0);

/** Share of the brightness that is left past the full scale. */
const PAST_SCALE = 0.75;

/** Hues and shares that the tables hold. */
const HUES = 1024;
const SHARES = 256;

/** Ramps from a low to a high value, for a dark and for a light background. */
const RAMPS = {
  dark: [
    [106, 92, 214],
    [62, 142, 216],
    [54, 184, 158],
    [166, 206, 88],
    [255, 224, 110],
  ],
  light: [
    [74, 58, 168],
    [36, 104, 178],
    [20, 134, 112],
    [112, 148, 26],
    [196, 142, 0],
  ],
};

/** Turn between the hues of consecutive ids: the golden angle, as a share. */
const GOLDEN = 0.381966;

/**
 * The pure color of a direction in the x-y plane: +x is red, and the hue turns counterclockwise.
 *
 * @param {number} turn Angle from +x, in turns.
 * @returns {number[]} Red, green, blue.
 */
export function hue(turn) {
  let step = (turn - Math.floor(turn)) * STEPS;
  for (let at = 0; at < WHEEL.length; at += 1) {
    const [steps, color] = WHEEL[at];
    if (step <= steps) return mix(color, WHEEL[(at + 1) % WHEEL.length][1], step / steps);
    step -= steps;
  }
  return WHEEL[0][1];
}

/** The color between two others. */
export function mix(from, to, share) {
  return from.map((value, channel) => value + share * (to[channel] - value));
}

/** A color as the 32 bits of four bytes: red, green, blue, and alpha 255. */
export function packed([red, green, blue]) {
  return (0xff000000 | (Math.round(blue) << 16) | (Math.round(green) << 8) | Math.round(red)) >>> 0;
}

const HUE_TABLE = Float32Array.from({ length: 3 * HUES }, (_, at) => hue(Math.floor(at / 3) / HUES)[at % 3]);

/**
 * The color of a motion, packed: the color of rest at no motion, the pure hue at the full scale, and
 * a darker one past it.
 *
 * @param {number} x Motion, in the unit of `scale`.
 * @param {number} y
 * @param {number} scale
 * @param {number[]} rest Color of no motion.
 * @returns {number}
 */
export function motionColor(x, y, scale, rest) {
  const turn = Math.atan2(y, x) / (2 * Math.PI);
  const at = 3 * (Math.round((turn + 1) * HUES) % HUES);
  const share = Math.hypot(x, y) / scale;
  if (!(share >= 0)) return packed(rest);
  if (share > 1) return packed([0, 1, 2].map((channel) => PAST_SCALE * HUE_TABLE[at + channel]));
  const red = rest[0] + share * (HUE_TABLE[at] - rest[0]);
  const green = rest[1] + share * (HUE_TABLE[at + 1] - rest[1]);
  const blue = rest[2] + share * (HUE_TABLE[at + 2] - rest[2]);
  return (0xff000000 | (blue << 16) | (green << 8) | red) >>> 0;
}

/**
 * The color of a value on the ramp.
 *
 * @param {number} share 0 to 1; values beyond are clamped.
 * @param {boolean} isDark Whether the background is dark.
 * @returns {number[]}
 */
export function ramp(share, isDark) {
  const stops = RAMPS[isDark ? "dark" : "light"];
  const place = Math.min(1, Math.max(0, share || 0)) * (stops.length - 1);
  const below = Math.min(stops.length - 2, Math.floor(place));
  return mix(stops[below], stops[below + 1], place - below);
}

/**
 * The ramp as packed colors, from share 0 to 1.
 *
 * @returns {Uint32Array} 256 colors.
 */
export function rampTable(isDark) {
  return Uint32Array.from({ length: SHARES }, (_, at) => packed(ramp(at / (SHARES - 1), isDark)));
}

/**
 * The color of an id: distinct for ids near each other, and the same in each sweep.
 *
 * @param {number} id
 * @param {boolean} isDark
 * @returns {number[]}
 */
export function idColor(id, isDark) {
  const position = 6 * ((id * GOLDEN + 0.08) % 1);
  const chroma = (channel) => Math.min(1, Math.max(0, Math.abs(((position + channel) % 6) - 3) - 1));
  const pure = [0, 4, 2].map((channel) => 255 * chroma(channel));
  const lightness = id % 2 === 0 ? 0.28 : 0.1;
  return isDark ? mix(pure, [255, 255, 255], lightness) : mix(pure, [0, 0, 0], 0.15 + lightness);
}

/**
 * The motion at which the wheel's colors are full, metres: the smallest of 0.1, 0.15, 0.2, 0.3, 0.4,
 * 0.5, 0.6, 0.8, 1, 1.5 ... that covers 98 % of the moving points. Rows with less than 0.05 m of
 * horizontal motion count as static.
 *
 * @param {Float32Array} motion 3N values, metres.
 * @param {Uint8Array} valid N flags.
 * @returns {number}
 */
export function fullScale(motion, valid) {
  const [least, covered] = [0.1, 0.98];
  const moving = new Float32Array(valid.length);
  let count = 0;
  for (let row = 0; row < valid.length; row += 1) {
    const length = Math.hypot(motion[3 * row], motion[3 * row + 1]);
    if (valid[row] && length >= least / 2) moving[count++] = length;
  }
  if (count === 0) return least;
  const sorted = moving.subarray(0, count).sort();
  return Math.max(least, roundUp(sorted[Math.floor((count - 1) * covered)]));
}

function roundUp(value) {
  const decade = 10 ** Math.floor(Math.log10(value));
  const step = [1, 1.5, 2, 3, 4, 5, 6, 8].find((step) => step * decade >= 0.999 * value);
  return (step ?? 10) * decade;
}
