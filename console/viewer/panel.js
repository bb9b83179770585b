/**
 * The controls of the viewer.
 */

import { button, el, field, fill, select } from "../dom.js";
import { COLORS } from "./frame.js";
import { VIEWS } from "./camera.js";

/** Layers of a pair, with the word for a reader. */
const LAYERS = [
  ["moved", "moved", "The source, moved by its flow to the time below"],
  ["source", "source", "The source at its own time"],
  ["target", "target", "The later sweep"],
  ["boxes", "objects", "Moving objects and their velocities"],
  ["tracks", "paths", "Where the objects were in earlier sweeps"],
];

const DENSE_COLORS = [["height", "height"], ["sweep", "sweep"], ["dynamic", "moving points"]];

const KEYS =
  "Keys: arrows turn, + − zoom, 1–4 cameras, F fit, space plays, [ ] sweeps, O next object, M measures, Esc ends.";

/**
 * Builds the controls. `state` is changed by them, and `changed(name)` is called then.
 *
 * @returns {{panel: HTMLElement, player: HTMLElement, update: Function}} `update(frame)`
 *   shows what is possible and what is set.
 */
export function buildControls(state, scene, changed, actions) {
  const toggle = (name, text, test, title) => {
    const box = el("input", { type: "checkbox", data: { test }, on: { change: () => set(name, box.checked) } });
    const label = el("label", { class: "fv-check", title }, box, text);
    return { box, label };
  };
  const set = (name, value) => {
    if (name.startsWith("layer.")) state.layers[name.slice(6)] = value;
    else state[name] = value;
    changed(name);
  };
  const layers = LAYERS.map(([name, text, title]) => [name, toggle(`layer.${name}`, text, `layer-${name}`, title)]);
  const ground = toggle("ground", "ground", "ground", "Points of no cluster: ground and noise");
  const ego = toggle("ego", "ego motion", "ego", "Whether the vehicle's own motion is shown");
  const dense = toggle("dense", "dense cloud", "mode-dense", "The points of all sweeps at one time");
  const color = select(Object.entries(COLORS).map(([name, { text }]) => [name, text]), state.color, (value) => set("color", value), { data: { test: "color" } });
  const denseColor = select(DENSE_COLORS, state.denseColor, (value) => set("denseColor", value));
  const confidence = el("input", { type: "range", min: "0", max: "1", step: "0.01", data: { test: "confidence" }, on: { input: () => set("confidence", Number(confidence.value)) } });
  const confidenceText = el("output", {});
  const shown = el("p", { class: "fv-shown", data: { test: "shown" } });
  const views = Object.keys(VIEWS).map((name, index) =>
    button(name, () => actions.camera(name), { data: { test: `camera-${name}` }, title: `Key ${index + 1}` }),
  );
  const ofPair = el(
    "div",
    {},
    el("fieldset", {}, el("legend", {}, "Show"), el("div", { class: "fv-pairs" }, layers.map(([, { label }]) => label), ground.label, ego.label)),
    field("Color", color),
    el("div", { class: "field" }, el("label", { for: "fv-confidence" }, "Least confidence ", confidenceText), confidence),
  );
  confidence.id = "fv-confidence";
  const ofDense = el("div", {}, field("Color", denseColor));
  const panel = el(
    "details",
    { class: "fv-panel" },
    el("summary", {}, "View"),
    dense.label,
    ofPair,
    ofDense,
    el("fieldset", {}, el("legend", {}, "Camera"), el("div", { class: "fv-buttons" }, views)),
    el(
      "div",
      { class: "fv-buttons" },
      button("Fit", actions.fit, { title: "Key F: the camera as at first" }),
      button("Measure", actions.measure, { data: { test: "measure" }, title: "Key M: two clicks on points" }),
      button("Picture", actions.screenshot, { data: { test: "screenshot" }, title: "Save as PNG" }),
    ),
    shown,
    el("p", { class: "hint" }, KEYS),
  );
  panel.open = matchMedia("(min-width: 641px)").matches;
  const player = buildPlayer(state, scene, set, actions);
  const update = (frame) => {
    for (const [name, { box }] of layers) box.checked = state.layers[name];
    ground.box.checked = state.ground;
    ego.box.checked = state.ego;
    dense.box.checked = state.dense;
    dense.label.hidden = !scene.hasDense || scene.sweeps === 0;
    ofPair.hidden = state.dense;
    ofDense.hidden = !state.dense;
    player.element.hidden = state.dense;
    enable(layers.find(([name]) => name === "tracks")[1].box, state.hasTracks, state.whyNoTracks);
    enable(layers.find(([name]) => name === "moved")[1].box, frame?.pair, "There is no flow.");
    enable(ground.box, frame?.pair?.cluster, "The method finds no clusters.");
    enable(ego.box, frame?.ego, "The ego motion is not known.");
    enable(confidence, frame?.pair?.confidence, "The method gives no confidence.");
    for (const option of color.options) {
      const { needs, why } = COLORS[option.value];
      option.disabled = frame ? !needs(frame) : false;
      option.title = option.disabled ? why : "";
    }
    color.value = frame?.shownColor(state.color) ?? state.color;
    confidence.value = String(state.confidence);
    setText(confidenceText, state.confidence.toFixed(2));
    // Read out by a screen reader, but not while it plays.
    shown.setAttribute("aria-live", state.isPlaying ? "off" : "polite");
    setText(shown, `${state.pointsDrawn.toLocaleString("en-US")} points`);
    player.update(frame);
  };
  return { panel, player: player.element, update };
}

/** Sets a text. A text that stays is not set again: a screen reader would repeat it. */
function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function enable(control, isPossible, why) {
  control.disabled = !isPossible;
  if (!isPossible) control.title = why;
  else control.removeAttribute("title");
}

/** The controls of time: within a pair, and over the sweeps of a sequence. */
function buildPlayer(state, scene, set, actions) {
  const play = button("▶", actions.play, { data: { test: "play" }, title: "Space", "aria-label": "Play" });
  const time = el("input", { type: "range", min: "0", max: "1", step: "0.01", "aria-label": "Time from source to target", data: { test: "time" }, on: { input: () => set("time", Number(time.value)) } });
  const timeText = el("span", { class: "fv-time" });
  const sweep = el("input", { type: "range", min: "0", max: String(Math.max(0, scene.sweeps - 1)), step: "1", "aria-label": "Sweep", data: { test: "sweep" }, on: { input: () => actions.sweep(Number(sweep.value)) } });
  const sweepText = el("span", { class: "fv-time" });
  const step = (by, text, label) => button(text, () => actions.sweep(state.sweep + by), { "aria-label": label, title: by < 0 ? "Key [" : "Key ]" });
  const speed = select([["1", "1×"], ["0.5", "½×"], ["0.2", "⅕×"]], "1", (value) => (state.speed = Number(value)), { "aria-label": "Speed", class: "fv-speed" });
  const isSequence = scene.sweeps > 2;
  const rows = [el("div", { class: "fv-row" }, play, time, timeText, speed)];
  if (isSequence) rows.push(el("div", { class: "fv-row" }, step(-1, "‹", "Previous sweep"), sweep, step(1, "›", "Next sweep"), sweepText));
  const element = el("div", { class: "fv-player", role: "group", "aria-label": "Time" });
  fill(element, rows);
  const update = (frame) => {
    time.value = String(state.time);
    time.disabled = !frame?.pair;
    setText(timeText, frame?.pair ? `${(state.time * frame.pair.dt).toFixed(3)} s` : "–");
    sweep.value = String(state.sweep);
    setText(sweepText, `${state.sweep + 1} / ${scene.sweeps}`);
    sweepText.title = scene.sweepNames?.[state.sweep] ?? "";
    setText(play, state.isPlaying ? "❚❚" : "▶");
    play.setAttribute("aria-label", state.isPlaying ? "Pause" : "Play");
  };
  return { element, update };
}
