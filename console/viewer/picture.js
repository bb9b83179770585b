/**
 * One picture: what of the scene is drawn, in which frame and color.
 */

import { identity } from "./matrix.js";
import { addGrid, addObject, addTrajectories, Lines } from "./lines.js";
import { labelOf } from "./objects.js";
import { showLabels } from "./overlay.js";
import { Renderer } from "./renderer.js";

/** Largest ratio of the canvas to the page's pixels. */
const MOST_RATIO = 2;

/** Sizes of points by layer, pixels at least. */
const SIZES = { target: 1.1, source: 1.2, moved: 1.5, dense: 1 };

/** Draws the scene of a viewer. */
export class Picture {
  /** @throws {Error} If the browser has no WebGL2. */
  constructor(viewer, host) {
    this.viewer = viewer;
    this.host = host;
    this.renderer = new Renderer(viewer.canvas, () => viewer.redraw());
    this.view = identity();
    this.readPalette();
  }

  /** Reads the colors of the theme. */
  readPalette() {
    const style = getComputedStyle(this.host);
    const probe = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
    const read = (name, fallback) => {
      probe.fillStyle = style.getPropertyValue(name).trim() || fallback;
      probe.fillRect(0, 0, 1, 1);
      return Array.from(probe.getImageData(0, 0, 1, 1).data.subarray(0, 3));
    };
    const background = read("--bg", "#0d141a");
    const isDark = background.reduce((sum, value) => sum + value, 0) < 380;
    this.palette = {
      background: background.map((value) => value / 255),
      grid: read("--muted", "#888"),
      rest: isDark ? [112, 126, 138] : [120, 130, 140],
      source: isDark ? [0.35, 0.65, 0.95] : [0.1, 0.4, 0.75],
      target: isDark ? [0.3, 0.36, 0.42] : [0.7, 0.74, 0.78],
    };
  }

  /** Takes a sweep and its flow. */
  take(frame) {
    this.renderer.set("source", { positions: frame.positions });
    this.renderer.set("target", { positions: frame.targetPositions ?? new Float32Array(0), motions: null, colors: null });
    this.move(frame);
  }

  /** Takes the motion of the points: with or without the ego motion. */
  move(frame) {
    this.motions = frame.motions(!this.viewer.state.ego);
    this.renderer.set("source", { motions: this.motions });
  }

  /** Colors the points of a sweep, and hides those below the threshold. */
  color(frame) {
    const { state, camera } = this.viewer;
    const painted = frame.colors({
      color: frame.shownColor(state.color),
      showsGround: state.ground,
      confidence: state.confidence,
      rest: this.palette.rest,
      groundZ: camera.groundZ,
    });
    this.colors = painted.colors;
    state.pointsDrawn = painted.shown;
    this.renderer.set("source", { colors: painted.colors });
  }

  /** Takes a dense cloud. */
  takeDense(frame) {
    const { state, camera } = this.viewer;
    this.colors = frame.colors(state.denseColor, this.palette.rest, camera.groundZ);
    state.pointsDrawn = frame.count;
    const isNew = this.dense !== frame;
    this.dense = frame;
    this.renderer.set("dense", isNew ? { positions: frame.positions, motions: null, colors: this.colors } : { colors: this.colors });
  }

  /** What can be picked, with the arrays that `pick` takes. Null if no point is drawn that has numbers. */
  pickable() {
    const { state, frame, denseFrame } = this.viewer;
    if (!state.dense && !state.layers.moved && !state.layers.source) return null;
    if (state.dense) return { positions: denseFrame.positions, motions: null, colors: this.colors, time: 0 };
    return { positions: frame.positions, motions: this.motions, colors: this.colors, time: this.#time() };
  }

  /** The place of a row as it is drawn. */
  placeOf(row) {
    const { state, frame, denseFrame } = this.viewer;
    return state.dense ? denseFrame.place(row) : frame.place(row, this.#time(), !state.ego);
  }

  /** The time at which the points are drawn that are picked. */
  #time() {
    const { state } = this.viewer;
    return state.layers.moved ? state.time : 0;
  }

  /** Draws everything. */
  draw({ tracks, egoOf }) {
    const { camera, canvas, state, frame, denseFrame } = this.viewer;
    const ratio = Math.min(MOST_RATIO, devicePixelRatio);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.max(1, Math.round(size * ratio)));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.view = camera.matrix(width / height);
    this.renderer.begin(this.view, this.palette.background, camera, ratio);
    const [grid, lines] = [new Lines(), new Lines()];
    addGrid(grid, camera.groundZ, this.palette.grid);
    this.renderer.drawLines(grid, 1);
    let labels = [];
    if (state.dense && denseFrame) this.#layer("dense", identity(), 0, null);
    else if (frame) {
      this.#drawSweep(frame);
      labels = this.#addObjects(lines, tracks, egoOf);
    }
    if (state.measured.length === 2) lines.add(...state.measured, [255, 90, 200]);
    this.renderer.drawLines(lines, 2);
    this.#label(labels);
  }

  #layer(name, frame, time, plain, size = SIZES[name]) {
    this.renderer.drawPoints(name, { frame, time, plain, size });
  }

  #drawSweep(frame) {
    const { state } = this.viewer;
    const { layers } = state;
    if (layers.target) this.#layer("target", frame.targetFrame(!state.ego), 0, this.palette.target);
    if (layers.source) this.#layer("source", identity(), 0, this.palette.source, SIZES.source);
    if (layers.moved && frame.pair) this.#layer("source", identity(), state.time, null, SIZES.moved);
    // Without a flow, the source is all there is.
    else if (layers.moved) this.#layer("source", identity(), 0, null, SIZES.moved);
  }

  /** Boxes, arrows and trajectories. Returns the labels of the boxes. */
  #addObjects(lines, tracks, egoOf) {
    const { state, frame, objects } = this.viewer;
    const shown = (objects ?? []).filter((object) => object.confidence >= state.confidence);
    if (state.layers.tracks && state.hasTracks) addTrajectories(lines, shown, tracks, state.sweep, egoOf);
    if (!state.layers.boxes) return [];
    const picked = { cluster: null, id: null, ...state.picked };
    const isPicked = (object) => (picked.id === null ? picked.cluster !== null && picked.cluster === object.cluster : picked.id === object.id);
    return shown.map((object) => {
      addObject(lines, object, frame, state.time, !state.ego, isPicked(object));
      const top = [object.center[0], object.center[1], object.center[2] + object.size[2] / 2];
      const dt = frame.pair?.dt ?? 0;
      const moved = top.map((value, axis) => value + dt * object.velocity[axis]);
      return { object, place: frame.placeOf(top, moved, state.time, !state.ego), text: labelOf(object), color: object.color, onClick: () => this.viewer.pickObject(object) };
    });
  }

  #label(labels) {
    const { state, labels: layer } = this.viewer;
    const texts = [...labels];
    if (state.measured.length === 2) {
      const [from, to] = state.measured;
      const apart = Math.hypot(...from.map((value, axis) => to[axis] - value));
      const middle = from.map((value, axis) => (value + to[axis]) / 2);
      texts.push({ place: middle, text: `${apart.toFixed(2)} m`, color: [255, 90, 200], onClick: null });
    }
    const places = showLabels(layer, texts, this.view);
    state.boxes = labels.map(({ object }, index) => places[index] && { ...places[index], cluster: object.cluster, id: object.id }).filter(Boolean);
  }

  /** Frees the memory of the graphics card. */
  dispose() {
    this.renderer.dispose();
  }
}
