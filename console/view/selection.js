/**
 * What was picked by a click, and distances between two clicks.
 */

import { nameOf, rowsOfDense, rowsOfObject, rowsOfPoint, rowsOfTarget } from "./card.js";
import { makeButton, setText } from "./elements.js";
import { labelOf } from "./objects.js";
import { pickEdge, pickInside, pickPoint } from "./picking.js";

/** Distance up to which an edge of a box is hit, and a point of the object comes before it, pixels. */
const EDGE_PX = 4;
const ON_POINT_PX = 3;

/** Preference of the colored points over the clouds behind them, pixels. */
const PREFERENCE = { moved: 0, dense: 0, source: 2, target: 4 };

/** The selection of a viewer. It writes `picked`, `measured` and `isMeasuring` of the state. */
export class Selection {
  /** Gives the place of the picked point in the scene as it is drawn; null if none is picked. */
  placeOf = null;

  /** @param {Viewer} viewer */
  constructor(viewer) {
    this.viewer = viewer;
  }

  /** Takes a click at pixels of the canvas. */
  click(x, y) {
    const { viewer } = this;
    const { picture, state } = viewer;
    const pointer = { x, y };
    const point = this.#point(pointer);
    if (state.isMeasuring) {
      if (point) this.#measure(point);
      return;
    }
    const edge = pickEdge(picture.boxes, picture.view, pointer, picture.size);
    // Behind most edges there are points of the ground; only those of the object come before its edge.
    const isOwn = point && point.apart < ON_POINT_PX && this.#clusterOf(point) === edge?.object.cluster;
    if (edge && edge.apart <= EDGE_PX && !isOwn) this.chooseObject(edge.object);
    else if (point) this.#choosePoint(point);
    else {
      const object = pickInside(picture.boxes, picture.view, pointer, picture.size);
      if (object) this.chooseObject(object);
      else this.clear();
    }
  }

  #point(pointer) {
    const { picture } = this.viewer;
    let best = null;
    for (const [layer, cloud] of Object.entries(picture.pickable())) {
      const found = pickPoint(cloud, pointer, picture.size);
      if (found && (!best || found.score + PREFERENCE[layer] < best.score)) {
        best = { ...found, layer, score: found.score + PREFERENCE[layer] };
      }
    }
    return best;
  }

  /** The cluster of a picked point; null if it has none. */
  #clusterOf({ layer, row }) {
    const cluster = layer === "moved" || layer === "source" ? this.viewer.frame.pair?.cluster?.[row] : null;
    return cluster >= 0 ? cluster : null;
  }

  #choosePoint({ layer, row }) {
    const { frame, dense, state, objects, card } = this.viewer;
    const cluster = this.#clusterOf({ layer, row });
    const object = cluster === null ? null : objects.find((object) => object.cluster === cluster);
    state.picked = { kind: "point", layer, row, cluster, id: object?.id ?? null, key: null };
    this.placeOf = this.#placer(layer, row);
    const rows =
      { target: () => rowsOfTarget(frame, row), dense: () => rowsOfDense(dense, row) }[layer] ??
      (() => rowsOfPoint(frame, row));
    const more = object
      ? [makeButton(`Show ${nameOf(object).toLowerCase()}`, () => this.chooseObject(object), { test: "show-object" })]
      : [];
    const title = { target: "Target point", dense: "Point" }[layer] ?? "Source point";
    card.show(title, rows(), more);
    const told = rows()
      .map(([name, value]) => `${name} ${value}`)
      .join("; ");
    this.#say(`${title}. ${told}`);
  }

  /** A function that gives the place of a point in the scene as it is drawn. */
  #placer(layer, row) {
    const { dense, picture, state } = this.viewer;
    if (layer === "dense") return () => dense.place(row);
    if (layer === "target") return () => picture.targetPlace(row);
    return () => picture.sourcePlace(row, layer === "moved" ? state.time : 0);
  }

  /** Picks an object. */
  chooseObject(object) {
    const { state, card } = this.viewer;
    state.picked = { kind: "object", row: null, cluster: object.cluster, id: object.id, key: object.key };
    this.placeOf = null;
    card.show(nameOf(object), rowsOfObject(object));
    this.#say(`${nameOf(object)}, ${labelOf(object)}, ${object.points} points`);
    this.viewer.redraw();
  }

  /** Follows what was picked to another sweep: a track is still there, a point or a cluster is not. */
  renew() {
    const { state, objects } = this.viewer;
    state.measured = [];
    if (!state.picked) return;
    const object =
      state.picked.kind === "object" && state.picked.id !== null && objects.find(({ key }) => key === state.picked.key);
    if (object) this.chooseObject(object);
    else this.clear();
  }

  /** Begins or ends measuring. */
  setMeasuring(isMeasuring) {
    const { state, hint } = this.viewer;
    this.placeOf = null;
    state.isMeasuring = isMeasuring;
    state.measured = [];
    setText(hint, isMeasuring ? "Click two points to measure their distance. Esc ends." : "");
    if (isMeasuring) {
      state.picked = null;
      this.viewer.card.hide();
    }
    this.viewer.redraw();
  }

  #measure({ layer, row }) {
    const { state, card } = this.viewer;
    const place = this.#placer(layer, row)();
    state.measured = state.measured.length === 1 ? [state.measured[0], place] : [place];
    this.viewer.redraw();
    if (state.measured.length < 2) return;
    const [x, y, z] = place.map((value, axis) => value - state.measured[0][axis]);
    const rows = [
      ["Distance", `${Math.hypot(x, y, z).toFixed(3)} m`],
      ["Horizontal", `${Math.hypot(x, y).toFixed(3)} m`],
      ["Vertical", `${z.toFixed(3)} m`],
      ["x, y, z", `${[x, y, z].map((value) => value.toFixed(3)).join(", ")} m`],
    ];
    card.show("Distance", rows);
    this.#say(`Distance ${rows[0][1]}, horizontal ${rows[1][1]}`);
  }

  /** Picks nothing, and ends measuring. */
  clear() {
    this.viewer.state.picked = null;
    this.viewer.card.hide();
    this.setMeasuring(false);
  }

  #say(text) {
    setText(this.viewer.live, text);
    this.viewer.redraw();
  }
}
