/**
 * Programs and arrays on the graphics card.
 */

/**
 * Compiles and links a program.
 *
 * @param {WebGL2RenderingContext} gl
 * @returns {{program: WebGLProgram, at: Object<string, WebGLUniformLocation>}} The program and the
 *   places of its uniforms by name.
 * @throws {Error} If the driver refuses it.
 */
export function buildProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  const shaders = [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ].map(([kind, text]) => {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    return shader;
  });
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const said = [gl.getProgramInfoLog(program), ...shaders.map((shader) => gl.getShaderInfoLog(shader))];
    throw new Error(`The graphics card refuses a program of the viewer. ${said.filter(Boolean).join(" ")}`);
  }
  for (const shader of shaders) gl.deleteShader(shader);
  return { program, at: uniformsOf(gl, program) };
}

function uniformsOf(gl, program) {
  const number = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
  const names = Array.from({ length: number }, (_, index) => gl.getActiveUniform(program, index).name);
  return Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
}

/** An array on the graphics card. Its memory is used again while new content fits. */
export class GpuArray {
  #capacity = 0;

  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.buffer = gl.createBuffer();
  }

  /** Takes a typed array. */
  write(array) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    if (array.byteLength > this.#capacity) {
      // A little more, since sweeps of a sequence differ in size.
      this.#capacity = Math.ceil(array.byteLength * 1.1);
      gl.bufferData(gl.ARRAY_BUFFER, this.#capacity, gl.DYNAMIC_DRAW);
    }
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, array);
  }

  /** Frees the memory. */
  free() {
    this.gl.deleteBuffer(this.buffer);
  }
}

/** The attributes of a cloud or of lines: one array each, and the state that binds them. */
export class Attributes {
  #arrays = new Map();

  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.state = gl.createVertexArray();
  }

  /**
   * Writes the attribute at a location; null disables it, and the constant value is used instead.
   *
   * @param {number} location
   * @param {Float32Array|Uint8Array|null} array Three floats or four bytes for each point.
   */
  set(location, array) {
    const { gl } = this;
    gl.bindVertexArray(this.state);
    if (array === null) {
      gl.disableVertexAttribArray(location);
    } else {
      const found = this.#arrays.get(location) ?? new GpuArray(gl);
      this.#arrays.set(location, found);
      found.write(array);
      gl.enableVertexAttribArray(location);
      if (array instanceof Float32Array) gl.vertexAttribPointer(location, 3, gl.FLOAT, false, 0, 0);
      else gl.vertexAttribPointer(location, 4, gl.UNSIGNED_BYTE, true, 0, 0);
    }
    gl.bindVertexArray(null);
  }

  /** Frees everything. */
  free() {
    for (const array of this.#arrays.values()) array.free();
    this.gl.deleteVertexArray(this.state);
  }
}
