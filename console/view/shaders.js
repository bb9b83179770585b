/**
 * The GLSL programs: points that move along their flow, and lines of some pixels' width.
 */

/** Attribute locations of points. */
export const POINT = { position: 0, motion: 1, color: 2 };

/** Attribute locations of lines; each instance is a segment. */
export const LINE = { start: 0, end: 1, color: 2 };

/** Points: `position + time * motion`, both in metres. A color with alpha 0 hides a point. */
export const POINT_VERTEX = `#version 300 es
layout(location = ${POINT.position}) in vec3 position;
layout(location = ${POINT.motion}) in vec3 motion;
layout(location = ${POINT.color}) in vec4 color;
uniform mat4 view;
uniform float time;
uniform float metres;
uniform float pixelsPerMetre;
uniform vec2 sizes;
uniform vec2 fade;
uniform float nearer;
uniform vec4 plain;
out vec4 shade;
void main() {
  gl_Position = view * vec4(position + time * motion, 1.0);
  float depth = max(gl_Position.w, 1e-3);
  gl_PointSize = clamp(metres * pixelsPerMetre / depth, sizes.x, sizes.y);
  float clearness = mix(1.0, 0.32, smoothstep(fade.x, fade.y, gl_Position.w));
  shade = vec4(mix(color.rgb, plain.rgb, plain.a), clearness);
  gl_Position.z -= nearer * gl_Position.w;
  if (color.a == 0.0) gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
}`;

/** Round points that fade into the background with their distance. */
export const POINT_FRAGMENT = `#version 300 es
precision mediump float;
uniform vec3 background;
uniform float isRound;
in vec4 shade;
out vec4 pixel;
void main() {
  vec2 fromCenter = gl_PointCoord - 0.5;
  if (isRound > 0.5 && dot(fromCenter, fromCenter) > 0.26) discard;
  pixel = vec4(mix(background, shade.rgb, shade.a), 1.0);
}`;

/** Segments as four corners each: `gl_VertexID` 0 and 1 at the start, 2 and 3 at the end. */
export const LINE_VERTEX = `#version 300 es
layout(location = ${LINE.start}) in vec3 start;
layout(location = ${LINE.end}) in vec3 end;
layout(location = ${LINE.color}) in vec4 color;
uniform mat4 view;
uniform vec2 size;
uniform float width;
out vec4 shade;
const float NEAR = 0.02;
vec4 clipped(vec4 point, vec4 other) {
  if (point.w >= NEAR) return point;
  return mix(point, other, (NEAR - point.w) / (other.w - point.w));
}
void main() {
  vec4 a = view * vec4(start, 1.0);
  vec4 b = view * vec4(end, 1.0);
  shade = color;
  if (a.w < NEAR && b.w < NEAR) {
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
    return;
  }
  vec4 from = clipped(a, b);
  vec4 to = clipped(b, a);
  vec2 along = (to.xy / to.w - from.xy / from.w) * size;
  vec2 unit = along / max(length(along), 1e-4);
  vec2 across = vec2(-unit.y, unit.x) * (gl_VertexID % 2 == 0 ? 1.0 : -1.0);
  gl_Position = gl_VertexID < 2 ? from : to;
  gl_Position.xy += across * width / size * gl_Position.w;
  gl_Position.z -= 2e-4 * gl_Position.w;
}`;

/** Lines in their own color. */
export const LINE_FRAGMENT = `#version 300 es
precision mediump float;
in vec4 shade;
out vec4 pixel;
void main() {
  pixel = vec4(shade.rgb * shade.a, shade.a);
}`;
