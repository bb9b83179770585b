/**
 * What the legend says for the settings of a viewer.
 */

import { DENSE_COLORS } from "./dense.js";
import { COLORS, HEIGHTS_M } from "./frame.js";

/**
 * The content of the legend.
 *
 * @param {Viewer} viewer
 * @returns {Object} As `Legend.show` takes it.
 */
export function legendOf({ state, frame, dense, picture }) {
  if (state.mode === "dense")
    return { title: DENSE_COLORS[state.denseColor], keys: [], ...denseBar(state.denseColor, dense) };
  const keys = keysOf(state, frame, picture.theme);
  if (!state.layers.moved) return { title: "Points", keys };
  if (!frame?.has(state.color)) return { title: "No flow", keys: [[picture.theme.rest, "this sweep"], ...keys] };
  return { title: COLORS[state.color].text, keys, ...scaleOf(state.color, frame) };
}

function scaleOf(color, frame) {
  const scale = frame?.scale(color);
  if (scale) return { wheel: { scale, dt: frame.pair.dt } };
  if (color === "cluster") return { ids: "one color for each cluster" };
  if (color === "height") return { bar: { from: `${HEIGHTS_M[0]} m`, to: `${HEIGHTS_M[1]} m` } };
  return { bar: { from: "0", to: "1" } };
}

function denseBar(color, dense) {
  if (color === "dynamic") return { bar: { from: "static", to: "moving", isMoving: true } };
  const [low, high] = dense?.range(color) ?? [0, 1];
  const unit = { height: " m", sweep: "", age: " sweeps" }[color];
  const text = (value) => `${Number(value.toFixed(1))}${unit}`;
  return { bar: { from: text(low), to: text(high) } };
}

function keysOf({ layers, color }, frame, theme) {
  const keys = [];
  if (layers.moved && frame?.pair && ["residual", "flow"].includes(color)) keys.push([theme.rest, "no motion"]);
  if (layers.moved && color === "cluster") keys.push([theme.rest, "no cluster"]);
  if (layers.source) keys.push([theme.source, "source, where it was"]);
  if (layers.target && frame?.target) keys.push([theme.target, "target, the next sweep"]);
  return keys;
}
