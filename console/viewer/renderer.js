/**
 * Draws clouds and lines with WebGL2. Buffers are reused from sweep to sweep, and made again after
 * the loss of the graphics card.
 */

import { linesProgram, pointsProgram } from "./shaders.js";

/** A cloud on the graphics card: positions, motions and colors of its points. */
class CloudBuffers {
  constructor(gl) {
    this.gl = gl;
    this.array = gl.createVertexArray();
    this.count = 0;
    this.parts = [
      { size: 3, type: gl.FLOAT, isNormalized: false },
      { size: 3, type: gl.FLOAT, isNormalized: false },
      { size: 4, type: gl.UNSIGNED_BYTE, isNormalized: true },
    ].map((part) => ({ ...part, buffer: gl.createBuffer(), bytes: 0 }));
  }

  /** Uploads the values of one attribute; null leaves it constant. */
  put(index, values) {
    const { gl } = this;
    const part = this.parts[index];
    gl.bindVertexArray(this.array);
    if (values === null) {
      gl.disableVertexAttribArray(index);
      return;
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, part.buffer);
    if (values.byteLength > part.bytes) {
      part.bytes = values.byteLength;
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    } else gl.bufferSubData(gl.ARRAY_BUFFER, 0, values);
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, part.size, part.type, part.isNormalized, 0, 0);
  }

  free() {
    for (const { buffer } of this.parts) this.gl.deleteBuffer(buffer);
    this.gl.deleteVertexArray(this.array);
  }
}

/** What is drawn on one canvas. */
export class Renderer {
  #clouds = new Map();
  #uploaded = new Map();

  /** @throws {Error} If the browser has no WebGL2. */
  constructor(canvas, onRestored) {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!gl) throw new Error("the view needs WebGL2, which this browser does not have or has switched off");
    this.gl = gl;
    this.canvas = canvas;
    this.#make();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.#clouds.clear();
      this.#make();
      for (const [name, parts] of this.#uploaded) this.#upload(name, parts);
      onRestored();
    });
  }

  #make() {
    this.points = pointsProgram(this.gl);
    this.lines = linesProgram(this.gl);
    this.lineBuffers = new CloudBuffers(this.gl);
  }

  /**
   * Sets parts of a cloud: `positions` and `motions` (3N float32), `colors` (4N bytes, alpha 0
   * hides). Parts that are left out stay; null motions mean rest.
   */
  set(name, parts) {
    const all = { ...this.#uploaded.get(name), ...parts };
    this.#uploaded.set(name, all);
    this.#upload(name, parts);
  }

  #upload(name, { positions, motions, colors }) {
    if (this.gl.isContextLost()) return;
    if (!this.#clouds.has(name)) this.#clouds.set(name, new CloudBuffers(this.gl));
    const cloud = this.#clouds.get(name);
    if (positions !== undefined) {
      cloud.put(0, positions);
      cloud.count = positions.length / 3;
    }
    if (motions !== undefined) cloud.put(1, motions);
    if (colors !== undefined) cloud.put(2, colors);
  }

  /** Begins a picture. `background` is a color, 0 to 1. */
  begin(view, background, camera, ratio) {
    const { gl, canvas } = this;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    Object.assign(this, { view, background, camera, ratio });
  }

  /** Draws a cloud in a frame at a time. `plain` is one color for all points, or null. */
  drawPoints(name, { frame, time, plain, size }) {
    const cloud = this.#clouds.get(name);
    if (!cloud || cloud.count === 0) return;
    const { gl, camera } = this;
    const { linked, uniforms } = this.points;
    gl.useProgram(linked);
    gl.bindVertexArray(cloud.array);
    gl.vertexAttrib3f(1, 0, 0, 0);
    gl.vertexAttrib4f(2, 1, 1, 1, 1);
    gl.uniformMatrix4fv(uniforms.view, false, this.view);
    gl.uniformMatrix4fv(uniforms.frame, false, frame);
    gl.uniform1f(uniforms.time, time);
    gl.uniform1f(uniforms.least, size * this.ratio);
    gl.uniform1f(uniforms.size, camera.isParallel ? size * this.ratio * 1.4 : 70 * size * this.ratio);
    gl.uniform1f(uniforms.fade, camera.isParallel ? 1e6 : Math.max(60, 3.2 * camera.distance));
    gl.uniform4f(uniforms.plain, ...(plain ?? [0, 0, 0]), plain ? 1 : 0);
    gl.uniform3f(uniforms.background, ...this.background);
    gl.drawArrays(gl.POINTS, 0, cloud.count);
  }

  /** Draws line segments of a width in pixels: starts and ends (3N values), and colors (4N bytes). */
  drawLines({ starts, ends, colors }, width) {
    if (starts.length === 0) return;
    const { gl, canvas } = this;
    const { linked, uniforms } = this.lines;
    gl.useProgram(linked);
    const values = [new Float32Array(starts), new Float32Array(ends), new Uint8Array(colors)];
    values.forEach((value, index) => {
      this.lineBuffers.put(index, value);
      gl.vertexAttribDivisor(index, 1);
    });
    gl.uniformMatrix4fv(uniforms.view, false, this.view);
    gl.uniform2f(uniforms.pixel, 2 / canvas.width, 2 / canvas.height);
    gl.uniform1f(uniforms.width, width * this.ratio);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, starts.length / 3);
    gl.disable(gl.BLEND);
  }

  /** Frees the memory of the graphics card. */
  dispose() {
    for (const cloud of this.#clouds.values()) cloud.free();
    this.lineBuffers.free();
    this.#clouds.clear();
    this.#uploaded.clear();
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
