/**
 * The numbers of what was picked: a point, an object, or a distance.
 */

import { button, el, fill } from "../dom.js";
import { count } from "../text.js";
import { labelOf, speedOf } from "./objects.js";

const metres = (values) => `${values.map((value) => value.toFixed(2)).join(", ")} m`;
const percent = (share) => `${Math.round(100 * share)}%`;

/** Fills the card. `close` is called by its button. */
export function showCard(card, title, rows, close) {
  const shown = rows.filter(([, value]) => value !== null);
  fill(
    card,
    el("div", { class: "fv-card-head" }, el("strong", {}, title), button("×", close, { class: "quiet", "aria-label": "Close the card" })),
    el("dl", { class: "facts" }, shown.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)])),
  );
  card.hidden = false;
}

/** The numbers of a point of a sweep. */
export function rowsOfPoint(frame, row) {
  const { pair, source, residual } = frame;
  const triple = (values) => Array.from(values.subarray(3 * row, 3 * row + 3));
  const rows = [["Position", metres(triple(source))], ["Row", count(row)]];
  if (!pair) return rows;
  if (!pair.valid[row]) return [...rows, ["Flow", "none"]];
  const speed = (motion) => `${(Math.hypot(...motion) / pair.dt).toFixed(2)} m/s`;
  rows.push(["Flow", metres(triple(pair.flow))]);
  if (residual) rows.push(["Residual motion", metres(triple(residual))], ["Speed", speed(triple(residual))]);
  else rows.push(["Speed", speed(triple(pair.flow))]);
  if (pair.confidence) rows.push(["Confidence", percent(pair.confidence[row])]);
  if (pair.moving) rows.push(["Moves", percent(pair.moving[row])]);
  if (pair.cluster) rows.push(["Cluster", pair.cluster[row] < 0 ? "none" : count(pair.cluster[row])]);
  return rows;
}

/** The numbers of an object. */
export function rowsOfObject(object) {
  const { velocity, size } = object;
  const heading = (180 * Math.atan2(velocity[1], velocity[0])) / Math.PI;
  return [
    ["Object", labelOf(object)],
    ["Speed", `${speedOf(object).toFixed(2)} m/s`],
    ["Heading", `${heading.toFixed(0)}° from forward`],
    ["Turn", `${((180 * object.yaw_rate) / Math.PI).toFixed(1)}°/s`],
    ["Size", metres(size)],
    ["Center", metres(object.center)],
    ["Points", count(object.points)],
    ["Confidence", percent(object.confidence)],
    ["Moves", object.moving === null ? null : percent(object.moving)],
  ];
}
