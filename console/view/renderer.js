/**
 * Draws clouds and lines with WebGL2, and keeps them over a loss of the context.
 */

import { Attributes, buildProgram, GpuArray } from "./gpu.js";
import { LINE, LINE_FRAGMENT, LINE_VERTEX, POINT, POINT_FRAGMENT, POINT_VERTEX } from "./shaders.js";

/** Bytes of a segment: two points of three floats, and a color. */
const SEGMENT_BYTES = 28;

/** Largest size of a point, pixels. */
const LARGEST = 5;

/** Draws on a canvas. Clouds have names, and are written attribute by attribute. */
export class Renderer {
  #clouds = new Map();
  #closing = new AbortController();

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {() => void} restored Called when the context is there again.
   * @throws {Error} If the browser has no WebGL2.
   */
  constructor(canvas, restored) {
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("This browser has no WebGL2, which the 3-D view needs.");
    const { signal } = this.#closing;
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault(), { signal });
    const restore = () => {
      this.#build();
      restored();
    };
    canvas.addEventListener("webglcontextrestored", restore, { signal });
    this.#build();
  }

  /** Everything on the graphics card, from the arrays that are known. */
  #build() {
    const { gl } = this;
    this.points = buildProgram(gl, POINT_VERTEX, POINT_FRAGMENT);
    this.lines = buildProgram(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.segments = this.#segmentAttributes();
    for (const cloud of this.#clouds.values()) {
      cloud.attributes = new Attributes(gl);
      for (const [name, array] of Object.entries(cloud.arrays)) cloud.attributes.set(POINT[name], array);
    }
  }

  #segmentAttributes() {
    const { gl } = this;
    const array = new GpuArray(gl);
    const state = gl.createVertexArray();
    gl.bindVertexArray(state);
    gl.bindBuffer(gl.ARRAY_BUFFER, array.buffer);
    const put = (location, size, type, isShare, offset) => {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, type, isShare, SEGMENT_BYTES, offset);
      gl.vertexAttribDivisor(location, 1);
    };
    put(LINE.start, 3, gl.FLOAT, false, 0);
    put(LINE.end, 3, gl.FLOAT, false, 12);
    put(LINE.color, 4, gl.UNSIGNED_BYTE, true, 24);
    gl.bindVertexArray(null);
    return { array, state };
  }

  /**
   * Writes arrays of a cloud; arrays that are not named stay as they are.
   *
   * @param {string} name
   * @param {{position?: Float32Array, motion?: Float32Array|null, color?: Uint8Array|null}} arrays For
   *   N points: 3N metres, 3N metres, 4N bytes red, green, blue, alpha.
   */
  write(name, arrays) {
    const cloud = this.#clouds.get(name) ?? { arrays: {}, attributes: new Attributes(this.gl) };
    this.#clouds.set(name, cloud);
    Object.assign(cloud.arrays, arrays);
    for (const [attribute, array] of Object.entries(arrays)) cloud.attributes.set(POINT[attribute], array);
  }

  /** Begins a picture. `background` is red, green, blue, 0 to 1. */
  begin(background) {
    const { gl } = this;
    this.background = background;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
  }

  /**
   * Draws a cloud in one call.
   *
   * @param {string} name
   * @param {Object} look `view` (matrix), `time` (0 to 1), `metres` (size of a point), `least` (its
   *   least size, pixels), `pixelsPerMetre`, `fade` (depths between which points fade), `nearer`
   *   (shift in depth that decides among points at one place), `plain` (a color with alpha, over the
   *   points' own), `isRound`.
   */
  drawPoints(name, look) {
    const cloud = this.#clouds.get(name);
    const count = (cloud?.arrays.position?.length ?? 0) / 3;
    if (count === 0) return;
    const {
      gl,
      points: { program, at },
    } = this;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.view, false, look.view);
    gl.uniform1f(at.time, look.time);
    gl.uniform1f(at.metres, look.metres);
    gl.uniform1f(at.pixelsPerMetre, look.pixelsPerMetre);
    gl.uniform2f(at.sizes, look.least, Math.max(LARGEST, look.least));
    gl.uniform2f(at.fade, ...look.fade);
    gl.uniform1f(at.nearer, look.nearer ?? 0);
    gl.uniform4f(at.plain, ...(look.plain ?? [0, 0, 0, 0]));
    gl.uniform3f(at.background, ...this.background);
    gl.uniform1f(at.isRound, look.isRound ? 1 : 0);
    gl.vertexAttrib3f(POINT.motion, 0, 0, 0);
    gl.vertexAttrib4f(POINT.color, 1, 1, 1, 1);
    gl.bindVertexArray(cloud.attributes.state);
    gl.drawArrays(gl.POINTS, 0, count);
    gl.bindVertexArray(null);
  }

  /**
   * Draws segments.
   *
   * @param {{bytes: Uint8Array, count: number}} segments As `Segments` holds them.
   * @param {{view: Float32Array, width: number, isOnTop?: boolean}} look `width` in pixels.
   */
  drawLines({ bytes, count }, look) {
    if (count === 0) return;
    const {
      gl,
      lines: { program, at },
    } = this;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.view, false, look.view);
    gl.uniform2f(at.size, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.uniform1f(at.width, look.width);
    this.segments.array.write(bytes);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    if (look.isOnTop) gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(this.segments.state);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
    gl.bindVertexArray(null);
    gl.enable(gl.DEPTH_TEST);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }

  /** Waits until the graphics card is done. */
  finish() {
    const { gl } = this;
    // Some browsers return from `finish` at once; a pixel that is read back is there only after all.
    gl.finish();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  /** Frees what lies on the graphics card. */
  dispose() {
    const { gl } = this;
    this.#closing.abort();
    for (const { attributes } of this.#clouds.values()) attributes.free();
    this.#clouds.clear();
    this.segments.array.free();
    gl.deleteVertexArray(this.segments.state);
    for (const { program } of [this.points, this.lines]) gl.deleteProgram(program);
    gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}
