/**
 * 4 x 4 matrices, column by column as WebGL takes them, and what the viewer does with them.
 */

/** The identity. */
export function identity() {
  return Float32Array.of(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1);
}

/**
 * The product: first `b` acts on a point, then `a`.
 *
 * @param {Float32Array} a
 * @param {Float32Array} b
 * @returns {Float32Array}
 */
export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let at = 0; at < 16; at += 1) {
    const [row, column] = [at & 3, at & 12];
    product[at] =
      a[row] * b[column] + a[row + 4] * b[column + 1] + a[row + 8] * b[column + 2] + a[row + 12] * b[column + 3];
  }
  return product;
}

/**
 * A matrix from its 16 numbers row by row, as arrays of the API hold it.
 *
 * @param {ArrayLike<number>} rows
 * @returns {Float32Array}
 */
export function transposed(rows) {
  return Float32Array.from({ length: 16 }, (_, at) => rows[4 * (at & 3) + (at >> 2)]);
}

/**
 * The inverse of a rotation followed by a translation.
 *
 * @param {Float32Array} rigid
 * @returns {Float32Array}
 */
export function rigidInverse(rigid) {
  const inverse = identity();
  for (let i = 0; i < 3; i += 1) {
    for (let j = 0; j < 3; j += 1) inverse[4 * j + i] = rigid[4 * i + j];
    inverse[12 + i] = -(rigid[4 * i] * rigid[12] + rigid[4 * i + 1] * rigid[13] + rigid[4 * i + 2] * rigid[14]);
  }
  return inverse;
}

/**
 * The affine map that is the identity at share 0 and `matrix` at share 1, linear between them.
 *
 * @param {Float32Array} matrix
 * @param {number} share 0 to 1.
 * @returns {Float32Array}
 */
export function blend(matrix, share) {
  const start = identity();
  return start.map((value, at) => value + share * (matrix[at] - value));
}

/**
 * The point where `matrix` leads a point.
 *
 * @param {Float32Array} matrix An affine map.
 * @param {number[]} point Three coordinates.
 * @returns {number[]}
 */
export function transform(matrix, [x, y, z]) {
  return [0, 1, 2].map((row) => matrix[row] * x + matrix[row + 4] * y + matrix[row + 8] * z + matrix[row + 12]);
}

/**
 * The place of a point in the picture. `depth` is not positive behind the camera.
 *
 * @param {Float32Array} matrix From the scene to clip space.
 * @param {number[]} point
 * @param {{width: number, height: number}} size Of the picture, pixels.
 * @returns {{x: number, y: number, depth: number}} Pixels from the upper left corner.
 */
export function project(matrix, [x, y, z], { width, height }) {
  const depth = matrix[3] * x + matrix[7] * y + matrix[11] * z + matrix[15];
  const right = (matrix[0] * x + matrix[4] * y + matrix[8] * z + matrix[12]) / depth;
  const up = (matrix[1] * x + matrix[5] * y + matrix[9] * z + matrix[13]) / depth;
  return { x: ((1 + right) / 2) * width, y: ((1 - up) / 2) * height, depth };
}
