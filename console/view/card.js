/**
 * The card with the numbers of what was picked.
 */

import { make, makeButton } from "./elements.js";
import { speedOf } from "./objects.js";

/** The card of a viewer. */
export class Card {
  /** @param {() => void} closed Called when the card is closed. */
  constructor(closed) {
    this.closed = closed;
    this.element = make("section", { class: "fv-card", test: "card", "aria-label": "What was picked", hidden: true });
  }

  /**
   * Shows numbers.
   *
   * @param {string} title
   * @param {string[][]} rows Names and values.
   * @param {HTMLElement[]} [actions] Buttons below.
   */
  show(title, rows, actions = []) {
    const list = rows.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value)));
    const close = makeButton("×", this.closed, { class: "fv-close", "aria-label": "Close", title: "Close (Esc)" });
    this.element.replaceChildren(make("header", {}, make("h2", {}, title), close), make("dl", {}, ...list), ...actions);
    this.element.hidden = false;
  }

  /** Hides the card. */
  hide() {
    this.element.hidden = true;
  }
}

const metres = (values) => `${values.map((value) => value.toFixed(2)).join(", ")} m`;
const percent = (share) => (share === null || share === undefined ? "not known" : `${Math.round(100 * share)} %`);
const speed = (metresPerSecond) => `${metresPerSecond.toFixed(2)} m/s, ${(3.6 * metresPerSecond).toFixed(1)} km/h`;

/** The numbers of a source point. */
export function rowsOfPoint(frame, row) {
  const three = (values) => Array.from(values.subarray(3 * row, 3 * row + 3));
  const { pair } = frame;
  const rows = [
    ["Row", row.toLocaleString("en-US")],
    ["Position", metres(three(frame.position))],
  ];
  if (!pair) return rows;
  if (!pair.valid[row]) return [...rows, ["Flow", "none for this point"]];
  const rate = (motion) => `${(Math.hypot(...motion) / pair.dt).toFixed(2)} m/s`;
  const motionRows = (name, motion) => [
    [name, metres(motion)],
    [`${name} speed`, rate(motion)],
  ];
  rows.push(...motionRows("Flow", three(frame.flow)));
  if (frame.residual) rows.push(...motionRows("Residual motion", three(frame.residual)));
  if (pair.confidence) rows.push(["Confidence", percent(pair.confidence[row])]);
  if (pair.moving) rows.push(["Chance of motion", percent(pair.moving[row])]);
  if (pair.cluster) rows.push(["Cluster", pair.cluster[row] < 0 ? "none" : String(pair.cluster[row])]);
  return rows;
}

/** The numbers of a target point. */
export function rowsOfTarget(frame, row) {
  const place = Array.from(frame.target.subarray(3 * row, 3 * row + 3));
  return [
    ["Row", row.toLocaleString("en-US")],
    ["Position", metres(place)],
    ["Frame", "of the target"],
  ];
}

/** The numbers of a point of a dense cloud. */
export function rowsOfDense(dense, row) {
  const { sweep, age, dynamic } = dense.arrays;
  return [
    ["Row", row.toLocaleString("en-US")],
    ["Position", metres(dense.place(row))],
    ["Sweep", String(sweep[row])],
    ["Age", `${Number(age[row].toFixed(2))} sweeps`],
    ["Moves", dynamic[row] ? "yes" : "no"],
  ];
}

/** The numbers of an object. */
export function rowsOfObject(object) {
  const degrees = (radians) => ((radians * 180) / Math.PI).toFixed(0);
  const { velocity, yaw, yawRate } = object;
  const rows = [
    ["Speed", speed(speedOf(object))],
    ["Moves toward", speedOf(object) < 0.3 ? "–" : `${degrees(Math.atan2(velocity[1], velocity[0]))}°`],
  ];
  rows.push(["Heading", `${degrees(yaw)}° from forward`], ["Turns", `${degrees(yawRate)}°/s`]);
  rows.push(
    ["Size", `${object.size.map((value) => value.toFixed(2)).join(" × ")} m`],
    ["Center", metres(object.center)],
  );
  rows.push(["Points", object.points.toLocaleString("en-US")], ["Confidence", percent(object.confidence)]);
  rows.push(["Chance of motion", percent(object.moving)]);
  if (object.cluster !== null) rows.push(["Cluster", String(object.cluster)]);
  if (object.id !== null) rows.push(["Track", `#${object.id}`]);
  return rows;
}

/** The name of an object for a title. */
export function nameOf(object) {
  return object.id === null ? `Object ${object.cluster}` : `Track #${object.id}`;
}
