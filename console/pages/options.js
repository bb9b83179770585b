/**
 * The options of a submission as a form, with their defaults and meanings.
 */

import { Refusal } from "../api.js";
import { el, field, select } from "../dom.js";

const PRESETS = {
  default: "the rigid motion of each object; a fraction of a second",
  label: "as default, with up to five sweeps of a sequence",
  neural: "a short, robust fit of a neural field",
  paper: "Fast Neural Scene Flow as published",
};

const OTHER_PRESET = "a method that the paper compares itself with";

const GROUND = [
  ["", "as the preset does"],
  ["auto", "auto: ground points get the ego motion"],
  ["keep", "keep: like any other point"],
  ["mask", "mask: left out, by the masks of the file"],
];

const EGO = [
  ["", "as the preset does"],
  ["auto", "auto: estimated first"],
  ["off", "off: not separated"],
];

const PRIORITIES = [
  ["normal", "normal"],
  ["low", "low"],
  ["high", "high"],
];

function number(properties) {
  return el("input", { type: "number", ...properties });
}

/**
 * The form.
 *
 * @param {string[]} presets The presets of the server, the default first.
 * @returns {{element: HTMLElement, read: () => Object}} `read` gives the options as the API takes
 *   them; what is empty is left out.
 */
export function optionsForm(presets) {
  const named = presets.map((name) => [name, `${name}: ${PRESETS[name] ?? OTHER_PRESET}`]);
  const preset = select(named, presets[0], () => {}, { data: { test: "preset" } });
  const ground = select(GROUND, "", () => {});
  const ego = select(EGO, "", () => {});
  const priority = select(PRIORITIES, "normal", () => {});
  const points = number({ min: "3", step: "1", placeholder: "all", data: { test: "max-points" } });
  const crop = number({ min: "0", step: "any", placeholder: "none" });
  const interval = number({ min: "0.001", max: "60", step: "any", placeholder: "file names, else 0.1" });
  const deadline = number({ min: "1", step: "1", placeholder: "none" });
  const seed = number({ min: "0", max: Number.MAX_SAFE_INTEGER, step: "1", placeholder: "0", data: { test: "seed" } });
  const labels = el("input", { type: "text", placeholder: "drive=7, split=val", data: { test: "labels" } });
  const dense = el("input", { type: "checkbox", data: { test: "densify" } });
  const force = el("input", { type: "checkbox" });
  const more = el(
    "details",
    {},
    el("summary", {}, "More options"),
    el(
      "div",
      { class: "fields" },
      field("Ground", ground),
      field("Ego motion", ego),
      field("Points", points, "Maximum number of source points that get a flow."),
      field("Crop, m", crop, "Half the side of a square about the sensor."),
      field("Seconds between sweeps", interval, "For the speeds of objects."),
      field("Deadline, ms", deadline, "The best flow so far is returned then."),
      field("Seed", seed, "The same seed gives the same flow."),
      field("Priority", priority),
      field("Labels", labels, "Pairs of name=value, by which the list of jobs can be filtered."),
    ),
    el("label", { class: "check" }, dense, "One dense cloud of all sweeps"),
    el("label", { class: "check" }, force, "Also pairs that do not look like two sweeps of one scene"),
  );
  const read = () => {
    const options = { preset: preset.value, priority: priority.value };
    const put = (name, control, convert) => {
      if (control.value !== "") options[name] = convert(control.value);
    };
    put("ground", ground, String);
    put("ego", ego, String);
    put("max_points", points, Number);
    put("crop_m", crop, Number);
    put("dt_s", interval, Number);
    put("deadline_ms", deadline, Number);
    put("seed", seed, readSeed);
    put("labels", labels, readLabels);
    if (dense.checked) options.densify = {};
    if (force.checked) options.force = true;
    return options;
  };
  return { element: el("div", {}, field("Method", preset), more), read };
}

/** Labels from `name=value, name=value`. */
function readSeed(text) {
  const seed = Number(text);
  // JavaScript's numbers hold no larger ones exactly.
  if (Number.isSafeInteger(seed) && seed >= 0) return seed;
  throw new Refusal(0, { detail: `a seed is a whole number from 0 to ${Number.MAX_SAFE_INTEGER}` });
}

function readLabels(text) {
  const pairs = text.split(",").filter((part) => part.trim() !== "");
  return Object.fromEntries(
    pairs.map((part) => {
      const [name, ...value] = part.split("=");
      return [name.trim(), value.join("=").trim()];
    }),
  );
}
