/**
 * The bar at the bottom: the time between the sweeps, and the sweeps of a sequence.
 */

import { make, makeButton, makeRange, makeSelect, setText } from "./elements.js";

const SPEEDS = [0.1, 0.25, 0.5, 1, 2];

/** The bar of a viewer. */
export class Player {
  /**
   * @param {Object} scene
   * @param {Object} actions `play()`, `time(share)`, `sweep(index)`, `speed(factor)`.
   */
  constructor(scene, actions) {
    this.scene = scene;
    this.play = makeButton("▶", actions.play, {
      class: "fv-button fv-play",
      test: "play",
      "aria-label": "Play",
      title: "Play or pause (space)",
    });
    this.time = makeRange(actions.time, {
      test: "time",
      min: 0,
      max: 1,
      step: 0.01,
      "aria-label": "Time from source to target",
      title: "Moves the source points along their flow",
    });
    this.timeText = make("output", { class: "fv-number" });
    this.speed = makeSelect(
      SPEEDS.map((speed) => [speed, `${speed}×`]),
      (value) => actions.speed(Number(value)),
      { "aria-label": "Speed of playing", title: "Speed of playing; 1× is real time for sequences" },
    );
    const timeLabel = make("span", { class: "fv-name", "aria-hidden": "true" }, "Time");
    this.element = make("div", { class: "fv-player", role: "group", "aria-label": "Time" });
    const row = make("div", { class: "fv-row" }, this.play, timeLabel, this.time, this.timeText, this.speed);
    this.element.append(row);
    if (scene.sweeps > 2) this.element.append(this.#sweeps(actions));
  }

  #sweeps(actions) {
    const step = (text, by, name, key) =>
      makeButton(text, () => actions.sweep(this.shown + by), { "aria-label": name, title: `${name} (${key})` });
    const last = this.scene.sweeps - 1;
    this.before = step("‹", -1, "Previous sweep", "[");
    this.next = step("›", 1, "Next sweep", "]");
    this.sweep = makeRange(actions.sweep, {
      test: "sweep",
      min: 0,
      max: last,
      step: 1,
      "aria-label": "Sweep",
      title: "Sweep of the sequence ([ and ])",
    });
    this.sweepText = make("output", { class: "fv-number" });
    this.sweepName = make("span", { class: "fv-file" });
    const label = make("span", { class: "fv-name", "aria-hidden": "true" }, "Sweep");
    return make("div", { class: "fv-row" }, this.before, this.next, label, this.sweep, this.sweepText, this.sweepName);
  }

  /** Shows the state. */
  update(state, frame) {
    const { play, time } = this;
    const hasTime = Boolean(frame?.pair) && state.mode === "sweeps";
    this.element.hidden = state.mode === "dense";
    setText(play, state.isPlaying ? "⏸" : "▶");
    play.setAttribute("aria-label", state.isPlaying ? "Pause" : "Play");
    play.disabled = !hasTime && this.scene.sweeps <= 2;
    time.disabled = !hasTime;
    time.value = state.time;
    const milliseconds = Math.round(1000 * state.time * (frame?.pair?.dt ?? 0));
    setText(this.timeText, hasTime ? `${milliseconds} ms` : "no flow");
    this.speed.value = state.speed;
    this.shown = state.sweep;
    if (!this.sweep) return;
    this.sweep.value = state.sweep;
    this.before.disabled = state.sweep === 0;
    this.next.disabled = state.sweep === this.scene.sweeps - 1;
    setText(this.sweepText, `${state.sweep + 1} / ${this.scene.sweeps}`);
    const name = this.scene.sweepNames?.[state.sweep] ?? "";
    setText(this.sweepName, name);
    this.sweepName.title = name;
  }
}
