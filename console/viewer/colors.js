/**
 * Colors of points: the wheel of directions, ramps of numbers, and distinct colors of ids.
 */

/** Steps of the wheel from red to yellow, green, cyan, blue, magenta and back. */
const STEPS = [15, 6, 4, 11, 13, 6];
const CORNERS = [[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1, 0, 0]];

/** Colors of a ramp from low to high, each readable on light and dark. */
const RAMP = [[68, 62, 150], [47, 108, 168], [34, 152, 155], [88, 190, 108], [196, 202, 60], [250, 170, 50]];

/** The pure color of a direction in the x-y plane: +x is red, then counterclockwise. */
export function hue(x, y) {
  const turn = Math.atan2(y, x) / (2 * Math.PI);
  let at = (turn - Math.floor(turn)) * STEPS.reduce((sum, steps) => sum + steps, 0);
  for (let corner = 0; corner < STEPS.length; corner += 1) {
    const share = at / STEPS[corner];
    if (share <= 1) return CORNERS[corner].map((value, channel) => value + share * (CORNERS[corner + 1][channel] - value));
    at -= STEPS[corner];
  }
  return CORNERS[0];
}

/** The hues of 256 directions, for speed. */
const HUES = Array.from({ length: 256 }, (_, at) => hue(Math.cos((at * Math.PI) / 128), Math.sin((at * Math.PI) / 128)));

/**
 * Writes the color of a horizontal motion: `rest` (0 to 255) for none, the pure hue from `fullScale`
 * on.
 */
export function putMotion(out, at, x, y, fullScale, rest) {
  const share = Math.min(1, Math.hypot(x, y) / fullScale);
  const turn = Math.atan2(y, x) / (2 * Math.PI);
  const pure = HUES[Math.round((turn + 1) * 256) & 255];
  const blend = Math.sqrt(share);
  for (let channel = 0; channel < 3; channel += 1) out[at + channel] = rest[channel] + blend * (255 * pure[channel] - rest[channel]);
}

/** The color of a share, 0 to 1, on the ramp: 0 to 255. */
export function ramp(share) {
  const at = Math.min(1, Math.max(0, share)) * (RAMP.length - 1);
  const low = Math.min(RAMP.length - 2, Math.floor(at));
  return RAMP[low].map((value, channel) => value + (at - low) * (RAMP[low + 1][channel] - value));
}

/** A color of its own for each id: 0 to 255. */
export function ofId(id) {
  const angle = 2 * Math.PI * ((id * 0.618034) % 1);
  const level = 0.72 + 0.28 * ((id * 0.41421) % 1);
  return hue(Math.cos(angle), Math.sin(angle)).map((value) => 255 * (0.2 + 0.8 * value) * level);
}

/**
 * The full scale of motions in metres: a round number, at least 0.1, that covers 98% of the points
 * that move by 0.05 m or more. The pictures of the command line have the same rule.
 *
 * @param {Float32Array} motion 3N values.
 * @param {Uint8Array} valid N flags.
 */
export function fullScale(motion, valid) {
  const stride = Math.max(1, Math.floor(valid.length / 40_000));
  const lengths = [];
  for (let row = 0; row < valid.length; row += stride) {
    const length = Math.hypot(motion[3 * row], motion[3 * row + 1]);
    if (valid[row] && length >= 0.05) lengths.push(length);
  }
  lengths.sort((a, b) => a - b);
  const covered = Math.max(0.1, lengths[Math.floor(0.98 * (lengths.length - 1))] ?? 0);
  const unit = 10 ** Math.floor(Math.log10(covered));
  return unit * [1, 1.5, 2, 3, 4, 5, 6, 8, 10].find((step) => step * unit >= covered * 0.999);
}
