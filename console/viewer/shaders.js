/**
 * The programs of the graphics card: points that move, and lines.
 */

const POINTS_VERTEX = `#version 300 es
uniform mat4 view;
uniform mat4 frame;
uniform float time;
uniform float size;
uniform float least;
uniform float fade;
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 motion;
layout(location = 2) in vec4 color;
out vec3 shade;
out float near;
void main() {
  gl_Position = view * frame * vec4(position + time * motion, 1.0);
  gl_PointSize = clamp(size / max(gl_Position.w, 0.01), least, 2.2 * least);
  near = clamp(1.15 - gl_Position.w / fade, 0.35, 1.0);
  shade = color.rgb;
  if (color.a == 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}`;

const POINTS_FRAGMENT = `#version 300 es
precision mediump float;
uniform vec4 plain;
uniform vec3 background;
in vec3 shade;
in float near;
out vec4 pixel;
void main() {
  vec3 color = mix(shade, plain.rgb, plain.a);
  pixel = vec4(mix(background, color, near), 1.0);
}`;

/** A segment is a strip of two triangles: corner 0 and 1 at its start, 2 and 3 at its end. */
const LINES_VERTEX = `#version 300 es
uniform mat4 view;
uniform vec2 pixel;
uniform float width;
layout(location = 0) in vec3 from;
layout(location = 1) in vec3 to;
layout(location = 2) in vec4 color;
out vec4 shade;
const float NEAR = 0.01;
void main() {
  vec4 a = view * vec4(from, 1.0);
  vec4 b = view * vec4(to, 1.0);
  if (a.w < NEAR && b.w < NEAR) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    return;
  }
  if (a.w < NEAR) a = mix(a, b, (NEAR - a.w) / (b.w - a.w));
  if (b.w < NEAR) b = mix(b, a, (NEAR - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) / pixel;
  float length_px = max(length(along), 1e-4);
  vec2 across = vec2(-along.y, along.x) / length_px * pixel * width * 0.5;
  vec4 end = gl_VertexID < 2 ? a : b;
  float side = gl_VertexID % 2 == 0 ? -1.0 : 1.0;
  gl_Position = end + vec4(across * side * end.w, 0.0, 0.0);
  shade = color;
}`;

const LINES_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade;
out vec4 pixel;
void main() {
  pixel = vec4(shade.rgb * shade.a, shade.a);
}`;

/**
 * A compiled program with the places of its uniforms.
 * @throws {Error} If the driver refuses it.
 */
function program(gl, vertex, fragment) {
  const linked = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`the graphics driver refuses a program: ${gl.getProgramInfoLog(linked)}`);
  }
  const uniforms = {};
  const count = gl.getProgramParameter(linked, gl.ACTIVE_UNIFORMS) ?? 0;
  for (let index = 0; index < count; index += 1) {
    const { name } = gl.getActiveUniform(linked, index);
    uniforms[name] = gl.getUniformLocation(linked, name);
  }
  return { linked, uniforms };
}

/** The program of points. */
export function pointsProgram(gl) {
  return program(gl, POINTS_VERTEX, POINTS_FRAGMENT);
}

/** The program of lines. */
export function linesProgram(gl) {
  return program(gl, LINES_VERTEX, LINES_FRAGMENT);
}
