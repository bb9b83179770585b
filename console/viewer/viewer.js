/**
 * The viewer: sweeps, their flow, moving objects and dense clouds in 3-D.
 */

import { el, fill } from "../dom.js";
import { count } from "../text.js";
import { Camera } from "./camera.js";
import { rowsOfObject, rowsOfPoint, showCard } from "./card.js";
import { DenseFrame, Frame, groundHeight } from "./frame.js";
import { listen } from "./gestures.js";
import { showLegend } from "./legend.js";
import { objectsOf } from "./objects.js";
import { buildControls } from "./panel.js";
import { Picture } from "./picture.js";
import { pick } from "./picking.js";
import { saveScreenshot } from "./screenshot.js";

/** Seconds that a pair without a sequence plays from source to target. */
const PAIR_SECONDS = 1.5;

const CAMERA_KEYS = { 1: "free", 2: "top", 3: "side", 4: "driver" };

/**
 * Creates a viewer that fills `host`.
 *
 * @param {HTMLElement} host
 * @param {Scene} scene What to draw, loaded when it is needed.
 * @returns {Viewer}
 */
export function createViewer(host, scene) {
  const viewer = new Viewer(host, scene);
  host.viewer = viewer;
  void viewer.start();
  return viewer;
}

/** A viewer. `state` holds its settings and what was drawn. */
export class Viewer {
  #scene;
  #host;
  #closing = new AbortController();
  #picture;
  #controls;
  #tracks = [];
  #egos = new Map();
  /** The sweep that was asked for last; it may still be loading. */
  #wanted = 0;
  /** The load in progress, and whether another one has to follow it. */
  #showing = null;
  #isStale = false;
  /** Whether the playback waits for its next sweep. */
  #isWaiting = false;
  #isDue = false;
  #playedAt = 0;
  #born = performance.now();

  constructor(host, scene) {
    this.#scene = scene;
    this.#host = host;
    this.camera = new Camera();
    this.state = {
      sweep: 0,
      time: 0,
      speed: 1,
      isPlaying: false,
      color: "residual",
      denseColor: "height",
      confidence: 0,
      ground: true,
      ego: false,
      dense: false,
      hasTracks: false,
      whyNoTracks: "There are no tracks.",
      layers: { moved: true, source: false, target: true, boxes: true, tracks: true },
      picked: null,
      isMeasuring: false,
      measured: [],
      boxes: [],
      pointsDrawn: 0,
      frames: 0,
      lastFrameMs: 0,
      firstPictureMs: null,
    };
    this.canvas = el("canvas", {
      class: "fv-canvas",
      tabindex: "0",
      role: "application",
      "aria-label": "Point cloud in 3-D. Drag turns, the wheel zooms, a click shows numbers.",
      data: { test: "view-canvas" },
    });
    this.labels = el("div", { class: "fv-labels" });
    this.legend = el("div", { class: "fv-legend", hidden: true });
    this.card = el("div", { class: "fv-card", role: "status", data: { test: "card" }, hidden: true });
    this.message = el("p", { class: "fv-message", role: "status" });
    fill(host, this.canvas, this.labels, this.legend, this.card, this.message);
  }

  /** Draws the first sweep. */
  async start() {
    const { signal } = this.#closing;
    try {
      this.#picture = new Picture(this, this.#host);
      this.#controls = buildControls(this.state, this.#scene, (name) => this.#changed(name), this.#actions());
    } catch (error) {
      this.#say(error.message);
      return;
    }
    this.#host.append(this.#controls.panel, this.#controls.player);
    listen(this.canvas, {
      camera: this.camera,
      moved: () => this.redraw(),
      clicked: (x, y) => this.#clicked(x, y),
      key: (key) => this.#key(key),
    }, signal);
    const resized = new ResizeObserver(() => this.redraw());
    resized.observe(this.#host);
    const repainted = new MutationObserver(() => this.#recolor());
    repainted.observe(document.documentElement, { attributeFilter: ["data-theme"] });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#recolor(), { signal });
    signal.addEventListener("abort", () => {
      resized.disconnect();
      repainted.disconnect();
    });
    if (this.#scene.sweeps === 0) this.state.dense = true;
    else await this.show(0);
    await this.#loadRest();
  }

  /** Shows what has become available since: flows, tracks, the dense cloud. */
  async reload() {
    // Without WebGL2 there is a message alone.
    if (!this.#controls) return;
    if (this.#scene.sweeps > 0) await this.show(this.#wanted);
    await this.#loadRest();
  }

  /** The tracks and the dense cloud, after the first picture. */
  async #loadRest() {
    this.state.whyNoTracks = "There are no tracks.";
    this.#tracks = await this.#scene.tracks().catch((error) => {
      this.state.whyNoTracks = `There are no tracks: ${error.message}`;
      return [];
    });
    this.state.hasTracks = this.#tracks.length > 0;
    if (this.#closing.signal.aborted) return;
    if (this.state.dense) await this.#showDense();
    if (this.frame) this.#collectEgos();
    this.#refresh();
  }

  /**
   * Shows a sweep and the pair that starts at it. One sweep is loaded at a time, then the one that was
   * asked for last.
   *
   * @returns {Promise<boolean>} Whether it could be loaded.
   */
  show(index) {
    this.#wanted = Math.min(this.#scene.sweeps - 1, Math.max(0, index));
    this.#isStale = true;
    this.#showing ??= this.#showWanted();
    return this.#showing;
  }

  async #showWanted() {
    let isShown = false;
    while (this.#isStale && !this.#closing.signal.aborted) {
      this.#isStale = false;
      isShown = await this.#showSweep(this.#wanted);
    }
    this.#showing = null;
    return isShown;
  }

  async #showSweep(sweep) {
    const isFirst = !this.frame;
    if (isFirst) this.#say("Loading the sweeps …");
    try {
      const [source, pair, target] = await Promise.all([
        this.#scene.sweep(sweep),
        this.#scene.pair(sweep),
        sweep + 1 < this.#scene.sweeps ? this.#scene.sweep(sweep + 1) : null,
      ]);
      if (this.#closing.signal.aborted) return false;
      this.frame = new Frame(source, target, pair);
      if (sweep !== this.state.sweep) this.#unpick();
      this.state.sweep = sweep;
      this.#say("");
      if (isFirst) this.#firstView();
      else if (pair && !this.hadPair) this.#firstColor();
      this.hadPair ||= pair !== null;
      this.#collectEgos();
      this.#picture.take(this.frame);
      this.#refresh();
    } catch (error) {
      this.#say(error.message);
      return false;
    }
    this.#prefetch(sweep + 2);
    return true;
  }

  /** What was picked in another sweep: an object with an identity is the same one in this sweep. */
  #unpick() {
    const id = this.state.picked?.id ?? null;
    this.state.picked = id === null ? null : { row: null, cluster: null, id };
    this.card.hidden = true;
  }

  /** The height of the ground, and what the first sweep cannot show. */
  #firstView() {
    this.camera.groundZ = groundHeight(this.frame.source);
    this.camera.set("free");
    this.#firstColor();
  }

  /** The color and the frame of the first flow. */
  #firstColor() {
    const { residual, pair, ego } = this.frame;
    this.state.color = residual ? "residual" : pair ? "flow" : "height";
    this.state.ego = pair !== null && ego === null;
  }

  #prefetch(sweep) {
    if (sweep >= this.#scene.sweeps) return;
    this.#scene.sweep(sweep).catch(() => {});
    this.#scene.pair(sweep - 1).catch(() => {});
  }

  /** The ego motions that lead the past of the tracks to the shown sweep. */
  #collectEgos() {
    if (this.frame.pair?.ego) this.#egos.set(this.state.sweep, this.frame.pair.ego);
    for (const pair of this.#scene.pairs) {
      if (pair.ego && !this.#egos.has(pair.source)) this.#egos.set(pair.source, pair.ego.flat());
    }
  }

  async #showDense() {
    this.#say("Loading the dense cloud …");
    let dense = null;
    try {
      dense = await this.#scene.dense();
      this.#say("");
    } catch (error) {
      this.state.dense = false;
      this.#say(error.message);
      this.redraw();
    }
    if (!dense || this.#closing.signal.aborted) return;
    this.denseFrame ??= new DenseFrame(dense);
    if (!this.frame) {
      this.camera.groundZ = groundHeight(this.denseFrame.positions);
      this.camera.set("free");
    }
    this.#refresh();
  }

  /** Colors and objects again, then a new picture. */
  #refresh() {
    const { state } = this;
    if (state.dense && this.denseFrame) this.#picture.takeDense(this.denseFrame);
    else if (this.frame) {
      this.objects = objectsOf(this.frame, this.#tracks, state.sweep);
      this.#picture.color(this.frame);
    }
    const { rest } = this.#picture.palette;
    const color = state.dense ? state.denseColor : (this.frame?.shownColor(state.color) ?? state.color);
    showLegend(this.legend, color, state.dense ? null : this.frame?.scale(color), this.frame?.pair?.dt ?? 0.1, rest);
    this.redraw();
  }

  #recolor() {
    this.#picture.readPalette();
    this.#refresh();
  }

  #changed(name) {
    if (name === "dense" && this.state.dense && !this.denseFrame) void this.#showDense();
    else if (name === "ego") {
      this.#picture.move(this.frame);
      this.#refresh();
    } else if (name === "time" || name.startsWith("layer.")) this.redraw();
    else this.#refresh();
  }

  /** Draws at the next frame of the display. */
  redraw() {
    if (this.#isDue || this.#closing.signal.aborted) return;
    this.#isDue = true;
    requestAnimationFrame((now) => {
      this.#isDue = false;
      if (this.#closing.signal.aborted) return;
      this.#advance(now);
      this.#draw();
      if (this.state.isPlaying && !this.#isWaiting) this.redraw();
    });
  }

  #draw() {
    const began = performance.now();
    this.#picture.draw({ tracks: this.#tracks, egoOf: (sweep) => this.#egos.get(sweep) ?? null });
    const { state } = this;
    state.lastFrameMs = performance.now() - began;
    state.frames += 1;
    if (state.firstPictureMs === null && state.pointsDrawn > 0) state.firstPictureMs = performance.now() - this.#born;
    this.#controls.update(this.frame);
  }

  /** Moves the time on while it plays. A sequence goes on to its next sweep. */
  #advance(now) {
    const { state } = this;
    if (!state.isPlaying || this.#isWaiting) return;
    const passed = Math.min(0.2, (now - this.#playedAt) / 1000);
    this.#playedAt = now;
    const isSequence = this.#scene.sweeps > 2;
    const seconds = isSequence ? (this.frame?.pair?.dt ?? 0.1) : PAIR_SECONDS;
    state.time += (state.speed * passed) / seconds;
    if (state.time < 1) return;
    state.time = isSequence ? 0 : state.time % 1;
    if (!isSequence) return;
    const next = (state.sweep + 1) % this.#scene.sweeps;
    this.#isWaiting = true;
    void this.show(next).then((isShown) => {
      this.#isWaiting = false;
      this.#play(state.isPlaying && isShown);
    });
  }

  #play(isPlaying) {
    this.state.isPlaying = isPlaying;
    this.#playedAt = performance.now();
    this.redraw();
  }

  #actions() {
    return {
      camera: (name) => {
        this.camera.set(name);
        this.redraw();
      },
      fit: () => {
        this.camera.set(this.camera.name);
        this.redraw();
      },
      play: () => this.#play(!this.state.isPlaying),
      sweep: (sweep) => {
        this.state.time = 0;
        void this.show(sweep);
      },
      measure: () => this.#measure(!this.state.isMeasuring),
      screenshot: () => {
        this.#draw();
        saveScreenshot(this.canvas, this.#host, `fnsf_${this.#scene.name}`.replace(/[^\w.-]+/g, "_"));
      },
    };
  }

  #key(key) {
    const { camera, state } = this;
    const actions = this.#actions();
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.06], ArrowDown: [0, -0.06] }[key];
    if (turn) camera.turn(...turn);
    else if (key === "+" || key === "-") camera.zoom(key === "+" ? 0.85 : 1 / 0.85);
    else if (CAMERA_KEYS[key]) camera.set(CAMERA_KEYS[key]);
    else if (key === " ") actions.play();
    else if (key === "[" || key === "]") actions.sweep(state.sweep + (key === "[" ? -1 : 1));
    else if (key.toLowerCase() === "f") actions.fit();
    else if (key.toLowerCase() === "m") actions.measure();
    else if (key.toLowerCase() === "o") this.#pickNext();
    else if (key === "Escape") this.#clear();
    else return false;
    this.redraw();
    return true;
  }

  #measure(isMeasuring) {
    this.state.isMeasuring = isMeasuring;
    this.state.measured = [];
    this.#say(isMeasuring ? "Click two points to measure their distance. Esc ends." : "");
    this.redraw();
  }

  #clear() {
    this.state.picked = null;
    this.card.hidden = true;
    this.#measure(false);
  }

  #clicked(x, y) {
    this.canvas.focus();
    if (!(this.state.dense ? this.denseFrame : this.frame)) return;
    const pointer = { x, y, width: this.canvas.clientWidth, height: this.canvas.clientHeight };
    const points = this.#picture.pickable();
    const row = points && pick(points, this.#picture.view, pointer);
    if (row === null) {
      if (!this.state.isMeasuring) this.#clear();
      return;
    }
    if (this.state.isMeasuring) this.#measured(row);
    else this.#picked(row);
    this.redraw();
  }

  #measured(row) {
    const { state } = this;
    const place = this.#picture.placeOf(row);
    state.measured = state.measured.length === 1 ? [state.measured[0], place] : [place];
    if (state.measured.length < 2) return;
    const apart = [0, 1, 2].map((axis) => state.measured[1][axis] - state.measured[0][axis]);
    const rows = [
      ["Distance", `${Math.hypot(...apart).toFixed(3)} m`],
      ["Horizontal", `${Math.hypot(apart[0], apart[1]).toFixed(3)} m`],
      ["Height", `${apart[2].toFixed(3)} m`],
    ];
    showCard(this.card, "Distance", rows, () => this.#clear());
  }

  #picked(row) {
    if (this.state.dense) {
      const { dense } = this.denseFrame;
      const place = this.denseFrame.place(row).map((value) => value.toFixed(2));
      const rows = [["Position", `${place.join(", ")} m`], ["Sweep", count(dense.sweep[row])], ["Moves", dense.dynamic[row] ? "yes" : "no"]];
      this.state.picked = { row, cluster: null };
      showCard(this.card, "Point", rows, () => this.#clear());
      return;
    }
    const cluster = this.frame.pair?.cluster?.[row] ?? -1;
    const object = this.objects.find((object) => object.cluster !== null && object.cluster === cluster);
    this.state.picked = { row, cluster: cluster < 0 ? null : cluster, id: object?.id ?? null };
    const rows = [...rowsOfPoint(this.frame, row), ...(object ? rowsOfObject(object) : [])];
    showCard(this.card, "Point", rows, () => this.#clear());
  }

  /** Picks the object after the picked one, among those that the picture shows. */
  #pickNext() {
    const { boxes, picked } = this.state;
    if (boxes.length === 0) return;
    const isPicked = ({ id, cluster }) => (id === null ? cluster === picked?.cluster : id === picked?.id);
    const next = boxes[(boxes.findIndex(isPicked) + 1) % boxes.length];
    const object = this.objects.find(({ id, cluster }) => id === next.id && cluster === next.cluster);
    // The boxes of the sweep before stay until the next one is drawn.
    if (object) this.pickObject(object);
  }

  /** Shows the numbers of an object whose label was clicked. */
  pickObject(object) {
    this.state.picked = { row: null, cluster: object.cluster, id: object.id };
    showCard(this.card, object.id === null ? "Object" : `Track #${object.id}`, rowsOfObject(object), () => this.#clear());
    this.redraw();
  }

  #say(text) {
    this.message.textContent = text;
    this.message.hidden = text === "";
  }

  /** Ends the viewer and frees what it holds. */
  dispose() {
    this.#closing.abort();
    this.state.isPlaying = false;
    this.#picture?.dispose();
    this.#host.replaceChildren();
    delete this.#host.viewer;
  }
}
