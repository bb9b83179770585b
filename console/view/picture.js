/**
 * One picture of the scene: which clouds, lines and labels are drawn, in which frame.
 */

import { withoutGround } from "./ground.js";
import { blend, identity, multiply, project, transform } from "./matrix.js";
import { labelOf, pathOf } from "./objects.js";
import { Renderer } from "./renderer.js";
import { addArrow, addBox, addGrid, addPath, ringLabels, Segments } from "./segments.js";
import { readTheme } from "./theme.js";

const MOST_PIXELS_PER_PIXEL = 2;

/** How the clouds are drawn: size of a point in metres, least size in pixels, shift in depth. */
const LOOKS = {
  target: { metres: 0.03, least: 1.1, nearer: 0 },
  source: { metres: 0.035, least: 1.2, nearer: 2e-5 },
  moved: { metres: 0.04, least: 1.5, nearer: 4e-5 },
  dense: { metres: 0.035, least: 1, nearer: 0 },
};

/** Draws the scene of a viewer. */
export class Picture {
  #colors = new Uint32Array(0);
  #targetPosition = null;
  #grounds = new WeakMap();
  #segments = {
    grid: new Segments(),
    lines: new Segments(),
    paths: new Segments(),
    picked: new Segments(),
    top: new Segments(),
  };
  /** Boxes of the last picture: `{object, corners}`. */
  boxes = [];
  view = identity();

  /**
   * @param {Viewer} viewer
   * @throws {Error} If the browser has no WebGL2.
   */
  constructor(viewer) {
    this.viewer = viewer;
    this.renderer = new Renderer(viewer.canvas, () => viewer.update());
    this.theme = readTheme(viewer.root);
  }

  /** Reads the colors of the page again. */
  readTheme() {
    this.theme = readTheme(this.viewer.root);
  }

  /** Takes the points of a sweep and the next one. */
  takeFrame(frame) {
    this.renderer.write("source", { position: frame.position });
    this.#targetPosition = frame.targetPosition;
    this.targetColors = null;
    this.renderer.write("target", { position: frame.targetPosition, color: null, motion: null });
    this.takeMotion(frame);
  }

  /** Takes the motion of the points, with or without the ego motion. */
  takeMotion(frame) {
    this.renderer.write("source", { motion: frame.motion(!this.viewer.state.ego) });
  }

  /** Takes the points of a dense cloud. */
  takeDense(dense) {
    this.renderer.write("dense", { position: dense.position, motion: null });
  }

  /** Colors the points, and counts those that are shown. */
  paint() {
    const { state, frame, dense, camera } = this.viewer;
    const { rest, isDark } = this.theme;
    const cloud = state.mode === "dense" ? dense : frame;
    if (!cloud) return;
    if (this.#colors.length < cloud.count) this.#colors = new Uint32Array(Math.ceil(1.1 * cloud.count));
    this.colors = this.#colors.subarray(0, cloud.count);
    const look = { rest, isDark, ground: camera.ground, hasGround: state.ground, confidence: state.confidence };
    state.pointsDrawn = cloud.paint(this.colors, {
      ...look,
      color: state.mode === "dense" ? state.denseColor : state.color,
    });
    const bytes = new Uint8Array(this.colors.buffer, 0, 4 * cloud.count);
    this.renderer.write(state.mode === "dense" ? "dense" : "source", { color: bytes });
    if (state.mode === "sweeps") this.#paintTarget(frame);
  }

  /** Hides the ground of the target where that of the source is hidden. */
  #paintTarget(frame) {
    const { state } = this.viewer;
    const isWhole = state.ground || !frame.pair?.cluster || !frame.target;
    const colors = isWhole ? null : (this.#grounds.get(frame) ?? withoutGround(frame));
    if (colors) this.#grounds.set(frame, colors);
    if (colors === this.targetColors) return;
    this.targetColors = colors;
    this.renderer.write("target", { color: colors && new Uint8Array(colors.buffer) });
  }

  /** The frames of points, target and objects at the state's time. */
  frames() {
    const { state, frame, isFollowing } = this.viewer;
    const lead = frame.ego && (state.ego || isFollowing) ? blend(frame.ego, state.time) : identity();
    if (state.ego || !frame.ego) return { points: identity(), target: identity(), objects: lead };
    return { points: lead, target: multiply(lead, frame.sourceFromTarget), objects: lead };
  }

  /** Draws everything, and places the labels. */
  draw() {
    const { canvas, camera, state, frame, dense } = this.viewer;
    const ratio = Math.min(MOST_PIXELS_PER_PIXEL, devicePixelRatio || 1);
    this.size = { width: canvas.clientWidth || 1, height: canvas.clientHeight || 1 };
    const [width, height] = [this.size.width, this.size.height].map((size) => Math.round(size * ratio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    this.ratio = ratio;
    this.view = camera.matrix(width / height);
    this.renderer.begin(this.theme.background.map((value) => value / 255));
    for (const segments of Object.values(this.#segments)) segments.clear();
    const labels = { objects: [], texts: state.layers.grid ? this.#grid() : [], marks: [] };
    this.boxes = [];
    if (state.mode === "dense" && dense) this.#cloud("dense", this.view, 0);
    else if (frame) this.#sweep(frame, labels);
    if (this.viewer.selection.placeOf) labels.marks.push(this.viewer.selection.placeOf());
    this.#measured(labels);
    this.#lines();
    return labels;
  }

  #grid() {
    const { camera } = this.viewer;
    addGrid(this.#segments.grid, camera.ground, this.theme.muted);
    this.renderer.drawLines(this.#segments.grid, { view: this.view, width: this.ratio });
    return ringLabels(camera.ground).map((label) => ({ ...label, kind: "ring" }));
  }

  #cloud(name, view, time, { plain = null, cloud = name } = {}) {
    const { camera } = this.viewer;
    const { metres, least, nearer } = LOOKS[name];
    this.renderer.drawPoints(cloud, {
      view,
      time,
      metres,
      nearer,
      least: least * this.ratio,
      pixelsPerMetre: camera.pixelsPerMetre(this.size.height * this.ratio),
      fade: [camera.distance + 15, camera.distance + 130],
      plain: plain && [...plain.map((value) => value / 255), 1],
      isRound: this.ratio > 1 || camera.distance < 30,
    });
  }

  #sweep(frame, labels) {
    const { state } = this.viewer;
    const { layers } = state;
    const { points, target, objects } = this.frames();
    const view = multiply(this.view, points);
    if (layers.target) this.#cloud("target", multiply(this.view, target), 0, { plain: this.theme.target });
    if (layers.source) this.#cloud("source", view, 0, { plain: this.theme.source });
    if (layers.moved) this.#cloud("moved", view, state.time, { cloud: "source" });
    this.#objects(frame, objects, labels);
  }

  #objects(frame, matrix, labels) {
    const { state, objects, tracks, egos } = this.viewer;
    const seconds = state.time * (frame.pair?.dt ?? 0);
    const lead = (point) => transform(matrix, point);
    for (const object of objects) {
      const isPicked = state.picked?.key === object.key;
      const isShown = isPicked || state.layers[object.isMain ? "boxes" : "still"];
      if (!isShown || object.confidence < state.confidence) continue;
      const segments = this.#segments[isPicked ? "picked" : "lines"];
      const corners = addBox(segments, object, seconds, lead, object.isMain || isPicked ? 1 : 0.55);
      if (object.isMoving) addArrow(segments, object, seconds, lead);
      this.boxes.push({ object, corners });
      const place = [0, 1, 2].map((axis) => corners.slice(4).reduce((sum, corner) => sum + corner[axis] / 4, 0));
      if (object.isMain || isPicked) labels.objects.push({ place, text: labelOf(object), object, isPicked });
    }
    if (!state.layers.tracks) return;
    const colors = new Map(objects.map(({ id, color }) => [id, color]));
    for (const { id, states } of tracks) {
      if (!colors.has(id)) continue;
      const path = pathOf(states, state.sweep, (sweep) => egos.between(sweep, state.sweep), transform);
      addPath(this.#segments.paths, path.map(lead), colors.get(id));
    }
  }

  #measured(labels) {
    const { measured } = this.viewer.state;
    labels.marks.push(...measured);
    if (measured.length < 2) return;
    const [from, to] = measured;
    this.#segments.top.add(from, to, this.theme.measure);
    const away = from.map((value, axis) => to[axis] - value);
    const text = `${Math.hypot(...away).toFixed(2)} m`;
    labels.texts.push({ place: from.map((value, axis) => value + away[axis] / 2), text, kind: "distance" });
  }

  #lines() {
    const { lines, paths, picked, top } = this.#segments;
    const look = (width, isOnTop) => ({ view: this.view, width: width * this.ratio, isOnTop });
    this.renderer.drawLines(paths, look(2.6, false));
    this.renderer.drawLines(lines, look(1.6, false));
    this.renderer.drawLines(picked, look(3.2, true));
    this.renderer.drawLines(top, look(2.2, true));
  }

  /** The places of the visible boxes' centers on the canvas: `x`, `y` in CSS pixels, `cluster`, `id`. */
  boxPlaces() {
    const { size, view } = this;
    const places = this.boxes.map(({ object, corners }) => {
      const middle = [0, 1, 2].map((axis) => corners.reduce((sum, corner) => sum + corner[axis] / 8, 0));
      return { ...project(view, middle, size), cluster: object.cluster, id: object.id };
    });
    return places.filter(({ x, y, depth }) => depth > 0 && x >= 0 && y >= 0 && x < size.width && y < size.height);
  }

  /** The clouds that can be picked, as `pickPoint` takes them, by name. */
  pickable() {
    const { state, frame, dense } = this.viewer;
    if (state.mode === "dense")
      return dense
        ? { dense: { position: dense.position, motion: null, time: 0, color: this.colors, view: this.view } }
        : {};
    if (!frame) return {};
    const { points, target } = this.frames();
    const view = multiply(this.view, points);
    const source = { position: frame.position, color: this.colors, view };
    const motion = frame.motion(!state.ego);
    return {
      ...(state.layers.moved && { moved: { ...source, motion, time: state.time } }),
      ...(state.layers.source && { source: { ...source, motion: null, time: 0 } }),
      ...(state.layers.target && {
        target: {
          position: this.#targetPosition,
          motion: null,
          time: 0,
          color: this.targetColors,
          view: multiply(this.view, target),
        },
      }),
    };
  }

  /** The place of a source point at a time in the drawn scene. */
  sourcePlace(row, time) {
    const { frame, state } = this.viewer;
    return transform(this.frames().points, frame.place(row, time, !state.ego));
  }

  /** The place of a target point in the drawn scene. */
  targetPlace(row) {
    const place = Array.from(this.#targetPosition.subarray(3 * row, 3 * row + 3));
    return transform(this.frames().target, place);
  }

  /** Frees what lies on the graphics card. */
  dispose() {
    this.renderer.dispose();
  }
}
