/**
 * The panel at the right: layers, colors, cameras and tools.
 */

import { DENSE_COLORS } from "./dense.js";
import { make, makeButton, makeCheck, makeRange, makeSelect, setEnabled, setText } from "./elements.js";
import { COLORS } from "./frame.js";

const LAYERS = {
  moved: ["Moved", "Source points, moved along their flow to the time below"],
  source: ["Source", "Source points where they were"],
  target: ["Target", "Points of the next sweep"],
  boxes: ["Objects", "Boxes, speeds and arrows of moving objects; an arrow is one second of motion"],
  still: ["Other clusters", "Boxes of clusters that do not move or have no track"],
  tracks: ["Paths", "Where tracked objects were in earlier sweeps"],
  grid: ["Grid", "Rings on the ground, 10 m apart, and the sensor's axes: x red, y green, z blue"],
};

const CAMERAS = { free: "Free", top: "Top", side: "Side", driver: "Driver" };

const KEYS = [
  ["drag, arrows", "turn"],
  ["shift or right drag", "move"],
  ["wheel, + −", "zoom"],
  ["1 2 3 4", "cameras"],
  ["F", "fit"],
  ["space", "play"],
  ["[ ]", "sweeps"],
  ["M", "measure"],
  ["Esc", "cancel"],
];

/** Number of panels so far, for ids. */
let panels = 0;

/** The panel of a viewer. */
export class Panel {
  /**
   * @param {Object} actions `set(name, value)` for `color`, `confidence`, `ground`, `ego`, `mode`;
   *   `layer(name, isOn)`, `camera(name)`, `fit()`, `measure()`, `screenshot()`.
   */
  constructor(actions) {
    this.actions = actions;
    this.body = make("div", { class: "fv-body", id: `fv-panel-${(panels += 1)}` });
    this.toggle = makeButton("View", () => this.collapse(!this.isCollapsed), {
      class: "fv-toggle",
      "aria-controls": this.body.id,
      title: "Show or hide the settings",
    });
    this.body.append(this.#modes(), this.#layers(), this.#colors(), this.#cameras(), this.#tools(), this.#keys());
    this.element = make("section", { class: "fv-panel", "aria-label": "Settings of the view" }, this.toggle, this.body);
    this.collapse(false);
  }

  /** Shows the heading alone, or everything. */
  collapse(isCollapsed) {
    this.isCollapsed = isCollapsed;
    this.body.hidden = isCollapsed;
    this.toggle.setAttribute("aria-expanded", String(!isCollapsed));
  }

  #modes() {
    const choose = (mode, text, test) =>
      makeButton(text, () => this.actions.set("mode", mode), { test, title: `Show the ${text.toLowerCase()}` });
    this.modeButtons = {
      sweeps: choose("sweeps", "Sweeps", "mode-sweeps"),
      dense: choose("dense", "Dense cloud", "mode-dense"),
    };
    this.modes = make(
      "div",
      { class: "fv-buttons fv-segments", role: "group", "aria-label": "What is shown", hidden: true },
      ...Object.values(this.modeButtons),
    );
    return this.modes;
  }

  #layers() {
    const checks = Object.entries(LAYERS).map(([name, [text, title]]) => {
      const check = makeCheck(text, (isOn) => this.actions.layer(name, isOn), { title, test: `layer-${name}` });
      return [name, check];
    });
    this.layerChecks = Object.fromEntries(checks);
    this.ground = makeCheck("Ground", (isOn) => this.actions.set("ground", isOn), { title: "", test: "ground" });
    this.ego = makeCheck("Ego motion", (isOn) => this.actions.set("ego", isOn), { title: "", test: "ego" });
    this.layers = group(
      "Show",
      make("div", { class: "fv-grid" }, ...Object.values(this.layerChecks), this.ground, this.ego),
    );
    return this.layers;
  }

  #colors() {
    const choices = Object.entries(COLORS).map(([name, { text }]) => [name, text]);
    this.color = makeSelect(choices, (value) => this.actions.set("color", value), {
      test: "color",
      "aria-label": "Color by",
      title: "What the colors of points show",
    });
    this.denseColor = makeSelect(Object.entries(DENSE_COLORS), (value) => this.actions.set("denseColor", value), {
      test: "dense-color",
      "aria-label": "Color by",
      title: "What the colors of points show",
    });
    this.confidence = makeRange((value) => this.actions.set("confidence", value), {
      test: "confidence",
      min: 0,
      max: 1,
      step: 0.01,
      "aria-label": "Least confidence",
    });
    this.confidenceText = make("output", { class: "fv-number" });
    this.shown = make("p", { class: "fv-shown", test: "shown" });
    const head = make("span", { class: "fv-between" }, make("span", {}, "Least confidence"), this.confidenceText);
    this.confidenceField = make("label", { class: "fv-field" }, head, this.confidence);
    return group("Color by", this.color, this.denseColor, this.confidenceField, this.shown);
  }

  #cameras() {
    const buttons = Object.entries(CAMERAS).map(([name, text], at) => {
      const button = makeButton(text, () => this.actions.camera(name), {
        test: `camera-${name}`,
        title: `Camera: ${text.toLowerCase()} (${at + 1})`,
      });
      return [name, button];
    });
    this.cameraButtons = Object.fromEntries(buttons);
    return group("Camera", make("div", { class: "fv-buttons fv-segments" }, ...Object.values(this.cameraButtons)));
  }

  #tools() {
    const fit = makeButton("Fit", this.actions.fit, { test: "fit", title: "Camera as at first (F)" });
    this.measure = makeButton("Measure", this.actions.measure, {
      test: "measure",
      title: "Distance of two points (M)",
    });
    const save = makeButton("Screenshot", this.actions.screenshot, {
      test: "screenshot",
      title: "Save the picture as PNG",
    });
    return make("div", { class: "fv-buttons" }, fit, this.measure, save);
  }

  #keys() {
    const rows = KEYS.map(([key, text]) => make("div", {}, make("dt", {}, key), make("dd", {}, text)));
    return make("details", { class: "fv-keys" }, make("summary", {}, "Keys"), make("dl", {}, ...rows));
  }

  /** Shows the state. `known` says what there is: `hasTracks`, `hasDense`, `sweeps`. */
  update(state, frame, known) {
    const isDense = state.mode === "dense";
    this.modes.hidden = !known.hasDense || known.sweeps === 0;
    for (const [name, button] of Object.entries(this.modeButtons))
      button.setAttribute("aria-pressed", String(state.mode === name));
    this.layers.hidden = isDense;
    this.color.hidden = this.confidenceField.hidden = isDense;
    this.denseColor.hidden = !isDense;
    this.denseColor.value = state.denseColor;
    this.#updateLayers(state, frame, known);
    this.#updateColors(state, frame);
    for (const [name, button] of Object.entries(this.cameraButtons))
      button.setAttribute("aria-pressed", String(state.camera === name));
    this.measure.setAttribute("aria-pressed", String(state.isMeasuring));
    setText(this.shown, `${state.pointsDrawn.toLocaleString("en-US")} points shown`);
  }

  #updateLayers(state, frame, { hasTracks }) {
    const pair = frame?.pair;
    const needs = {
      moved: [true, ""],
      source: [true, ""],
      target: [frame?.target, "This is the last sweep."],
      boxes: [hasTracks || pair?.clusters?.length > 0, "There are no objects: this method finds no clusters."],
      still: [pair?.clusters?.length > 0, "This method finds no clusters."],
      tracks: [hasTracks, "There are no tracks: they need a sequence and a method that finds clusters."],
      grid: [true, ""],
    };
    for (const [name, check] of Object.entries(this.layerChecks)) {
      const [isThere, why] = needs[name];
      check.control.checked = state.layers[name] && Boolean(isThere);
      setEnabled(check.control, Boolean(isThere), LAYERS[name][1], why);
    }
    this.ground.control.checked = state.ground;
    setEnabled(
      this.ground.control,
      Boolean(pair?.cluster),
      "Points of no cluster: ground and noise",
      "This method finds no clusters.",
    );
    this.ego.control.checked = state.ego;
    setEnabled(
      this.ego.control,
      Boolean(frame?.ego),
      "On: the flow as it is, with the vehicle's motion. Off: without it",
      "The ego motion of this flow is not known.",
    );
  }

  #updateColors(state, frame) {
    this.color.value = state.color;
    for (const option of this.color.options) {
      option.disabled = !frame?.has(option.value);
      option.title = option.disabled ? COLORS[option.value].why : "";
    }
    this.confidence.value = state.confidence;
    setText(this.confidenceText, state.confidence.toFixed(2));
    setEnabled(
      this.confidence,
      Boolean(frame?.pair?.confidence),
      "Hides points and boxes with less confidence",
      COLORS.confidence.why,
    );
  }
}

function group(text, ...children) {
  return make("fieldset", { class: "fv-group" }, make("legend", {}, text), ...children);
}
