/**
 * Loads what the viewer draws: sweeps, flows, tracks and the dense cloud. Arrays are fetched when
 * they are asked for, and only the latest ones are kept.
 */

import { buffer, json } from "./api.js";
import { floats, readNpz } from "./npz.js";

/** Number of sweeps and of flows that are kept. */
const KEPT = 12;

const NPZ = "application/x-npz";

const FLOW_ARRAYS = [
  "flow",
  "valid",
  "dynamic",
  "cluster",
  "confidence",
  "moving",
  "ego",
  "clusters_points",
  "clusters_dynamic",
  "clusters_center",
  "clusters_size",
  "clusters_velocity",
  "clusters_yaw",
  "clusters_yaw_rate",
  "clusters_confidence",
  "clusters_moving",
];

/** A map that keeps the latest `KEPT` promises, so that each address is fetched once. */
class Latest {
  #found = new Map();

  get(name, load) {
    const found = this.#found.get(name) ?? load();
    this.#found.delete(name);
    this.#found.set(name, found);
    found.catch(() => this.#found.delete(name));
    if (this.#found.size > KEPT) this.#found.delete(this.#found.keys().next().value);
    return found;
  }
}

/**
 * Opens a scene.
 *
 * @param {string} path The address of its description, such as `/v1/jobs/ID/scene`.
 * @returns {Promise<Scene>}
 */
export async function openScene(path) {
  const scene = new Scene(path);
  await scene.refresh();
  return scene;
}

/** The sweeps of a job or of local files, their flows and their tracks. */
export class Scene {
  #path;
  #described;
  #arrays = new Latest();
  #tracks = null;
  /** Number of pairs that had ended when the tracks were asked for. */
  #tracksOf = 0;
  #dense = null;

  constructor(path) {
    this.#path = path;
  }

  /** Fetches the description again: pairs may have ended since. */
  async refresh() {
    this.#described = await json(this.#path);
    // The server finds all tracks again for each answer: a running sequence gets them now and then.
    const ended = this.#ended();
    if (ended === this.pairs.length || ended >= 1.5 * this.#tracksOf) this.#tracks = null;
  }

  #ended() {
    return this.pairs.filter((pair) => pair.state === "succeeded").length;
  }

  get name() {
    return this.#described.name;
  }

  /** The number of sweeps. */
  get sweeps() {
    return this.#described.sweeps.length;
  }

  /** The names of the sweeps, where they are known. */
  get sweepNames() {
    return this.#described.sweep_names ?? [];
  }

  /** The pairs: `{source, target, state}`. */
  get pairs() {
    return this.#described.pairs;
  }

  /**
   * The points of a sweep: 3N values, metres. Rows without a return are NaN.
   * @returns {Promise<Float32Array>}
   */
  sweep(index) {
    const path = this.#described.sweeps[index];
    return this.#arrays.get(path, async () => new Float32Array(await buffer(path)));
  }

  /**
   * The flow from a sweep to the next, with the clusters. Null if there is none (yet).
   * @returns {Promise<Object|null>}
   */
  async pair(source) {
    const pair = this.pairs.find((pair) => pair.source === source);
    if (!pair || pair.state !== "succeeded") return null;
    return this.#arrays.get(pair.flow, async () => readPair(pair, await buffer(pair.flow, NPZ)));
  }

  /** Whether there is a dense cloud. */
  get hasDense() {
    return this.#described.dense !== null;
  }

  /**
   * The tracks of moving objects; an empty list if the job has none.
   *
   * @throws {Refusal} If the server refuses them, such as for a method without clusters.
   */
  tracks() {
    if (!this.#tracks) {
      this.#tracksOf = this.#ended();
      this.#tracks = this.#loadTracks();
    }
    return this.#tracks;
  }

  async #loadTracks() {
    // Tracks begin with the first pair.
    if (!this.#described.tracks || this.pairs[0]?.state !== "succeeded") return [];
    return (await json(this.#described.tracks)).tracks;
  }

  /** The dense cloud. Null if there is none. */
  dense() {
    this.#dense ??= this.#loadDense().catch((error) => {
      this.#dense = null;
      throw error;
    });
    return this.#dense;
  }

  async #loadDense() {
    if (!this.#described.dense) return null;
    const file = await buffer(this.#described.dense, NPZ);
    const arrays = await readNpz(file, ["points", "sweep", "age", "dynamic"]);
    // Another program may have saved a file of this machine with other types.
    for (const name of Object.keys(arrays)) arrays[name] = name === "dynamic" ? arrays[name] : floats(arrays[name]);
    return arrays;
  }
}

async function readPair(pair, file) {
  const arrays = await readNpz(file, FLOW_ARRAYS);
  const optional = (name) => arrays[name] ?? null;
  return {
    source: pair.source,
    target: pair.target,
    dt: pair.dt_s ?? 0.1,
    flow: arrays.flow,
    valid: arrays.valid,
    dynamic: optional("dynamic"),
    cluster: optional("cluster"),
    confidence: optional("confidence"),
    moving: optional("moving"),
    ego: optional("ego"),
    clusters: readClusters(arrays),
  };
}

function readClusters(arrays) {
  const points = arrays.clusters_points ?? [];
  const triple = (name, row) => Array.from(arrays[name].subarray(3 * row, 3 * row + 3));
  return Array.from(points, (number, row) => ({
    points: number,
    dynamic: arrays.clusters_dynamic[row] !== 0,
    center: triple("clusters_center", row),
    size: triple("clusters_size", row),
    velocity: triple("clusters_velocity", row),
    yaw: arrays.clusters_yaw[row],
    yaw_rate: arrays.clusters_yaw_rate[row],
    confidence: arrays.clusters_confidence[row],
    moving: arrays.clusters_moving[row],
  }));
}
