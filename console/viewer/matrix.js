/**
 * 4 x 4 matrices in the column order of WebGL, and rigid motions.
 */

/** The product a b. */
export function multiply(a, b) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column += 1) {
    for (let row = 0; row < 4; row += 1) {
      let sum = 0;
      for (let k = 0; k < 4; k += 1) sum += a[4 * k + row] * b[4 * column + k];
      product[4 * column + row] = sum;
    }
  }
  return product;
}

/** A perspective projection. `fov` is the vertical field of view in radians. */
export function perspective(fov, aspect, near, far) {
  const f = 1 / Math.tan(fov / 2);
  const depth = near - far;
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / depth, -1, 0, 0, (2 * far * near) / depth, 0]);
}

/** A parallel projection of `height` metres. */
export function parallel(height, aspect, near, far) {
  const depth = near - far;
  return new Float32Array([2 / (height * aspect), 0, 0, 0, 0, 2 / height, 0, 0, 0, 0, 2 / depth, 0, 0, 0, (far + near) / depth, 1]);
}

/** The view from `eye` along `forward`, with `up` for the picture's vertical: unit vectors. */
export function viewFrom(eye, forward, up) {
  const right = cross(forward, up);
  const dot = (axis) => -(axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2]);
  const back = forward.map((value) => -value);
  return new Float32Array([
    right[0], up[0], back[0], 0,
    right[1], up[1], back[1], 0,
    right[2], up[2], back[2], 0,
    dot(right), dot(up), dot(back), 1,
  ]);
}

/** The cross product of two vectors. */
export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** The identity. */
export function identity() {
  return new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
}

/** A rigid motion from 16 numbers row by row, as the API gives it. */
export function fromRows(rows) {
  const matrix = new Float32Array(16);
  for (let at = 0; at < 16; at += 1) matrix[4 * (at % 4) + Math.floor(at / 4)] = rows[at];
  return matrix;
}

/** The inverse of a rigid motion. */
export function inverseRigid(m) {
  const inverse = identity();
  for (let row = 0; row < 3; row += 1) {
    for (let column = 0; column < 3; column += 1) inverse[4 * column + row] = m[4 * row + column];
    inverse[12 + row] = -(m[4 * row] * m[12] + m[4 * row + 1] * m[13] + m[4 * row + 2] * m[14]);
  }
  return inverse;
}

/** A point after a motion. */
export function apply(m, [x, y, z]) {
  return [
    m[0] * x + m[4] * y + m[8] * z + m[12],
    m[1] * x + m[5] * y + m[9] * z + m[13],
    m[2] * x + m[6] * y + m[10] * z + m[14],
  ];
}

/** Picture coordinates of a point, in pixels from the upper left corner, and its depth w. */
export function project(m, [x, y, z], width, height) {
  const w = m[3] * x + m[7] * y + m[11] * z + m[15];
  const [clipX, clipY] = [0, 1].map((row) => m[row] * x + m[4 + row] * y + m[8 + row] * z + m[12 + row]);
  return { x: (0.5 + (0.5 * clipX) / w) * width, y: (0.5 - (0.5 * clipY) / w) * height, w };
}
