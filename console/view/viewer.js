/**
 * The viewer: sweeps, their flow, objects and dense clouds in 3-D.
 */

import { Camera } from "./camera.js";
import { commandsOf, pressKey } from "./commands.js";
import { Dense } from "./dense.js";
import { Egos } from "./egos.js";
import { setText } from "./elements.js";
import { extent, Frame } from "./frame.js";
import { listenTo } from "./gestures.js";
import { buildLayout } from "./layout.js";
import { legendOf } from "./legend_content.js";
import { objectsOf } from "./objects.js";
import { Picture } from "./picture.js";
import { Playback } from "./playback.js";
import { Selection } from "./selection.js";
import { initialState, isSequence } from "./state.js";
import { watchTheme } from "./theme.js";

/**
 * Creates a viewer that fills `host`, and begins to load the scene.
 *
 * @param {HTMLElement} host A positioned element. Its `viewer` becomes the viewer.
 * @param {Object} scene What to show, loaded when it is needed: `name`, `sweeps`, `pairs`,
 *   `sweep(i)`, `pair(i)`, `tracks()`, `dense()`, and optionally `sweepNames`, `hasDense` and
 *   `measure` (true: times of pictures include the graphics card's).
 * @returns {Viewer}
 */
export function createViewer(host, scene) {
  const viewer = new Viewer(host, scene);
  host.viewer = viewer;
  void viewer.start();
  return viewer;
}

/** A viewer. `state` holds its settings and what the last picture shows. */
export class Viewer {
  #closing = new AbortController();
  #born = performance.now();
  #asked = 0;
  #isDue = false;
  #hadPair = false;
  #denseArrays = null;
  frame = null;
  dense = null;
  objects = [];
  tracks = [];
  camera = new Camera();

  constructor(host, scene) {
    this.host = host;
    this.scene = scene;
    this.state = initialState(scene);
    this.egos = new Egos(scene);
    this.selection = new Selection(this);
    this.playback = new Playback(this);
    this.commands = commandsOf(this);
    buildLayout(this);
  }

  /** Whether there are more sweeps than those of one pair. */
  get isSequence() {
    return isSequence(this.scene);
  }

  /** Whether the static scene streams past the vehicle, as it does while a sequence plays. */
  get isFollowing() {
    return this.isSequence && this.state.isPlaying && !this.state.ego;
  }

  /** Whether `dispose` was called. */
  get isClosed() {
    return this.#closing.signal.aborted;
  }

  /** Connects the canvas, and shows the first sweep. */
  async start() {
    try {
      this.picture = new Picture(this);
    } catch (error) {
      setText(this.hint, error.message);
      return;
    }
    const { signal } = this.#closing;
    const to = {
      camera: this.camera,
      moved: () => this.redraw(),
      clicked: (x, y) => this.#clicked(x, y),
      pressed: (event) => pressKey(this, event),
    };
    listenTo(this.canvas, to, signal);
    watchTheme(() => this.#repaint(), signal);
    const resized = new ResizeObserver(() => this.redraw());
    resized.observe(this.root);
    signal.addEventListener("abort", () => resized.disconnect());
    if (this.scene.sweeps > 0) await this.show(0);
    await this.#loadRest();
  }

  #clicked(x, y) {
    this.canvas.focus({ preventScroll: true });
    this.selection.click(x, y);
  }

  /**
   * Shows a sweep and the pair that begins there.
   *
   * @param {number} index
   * @returns {Promise<void>} Fulfilled when it is drawn next, or when another sweep was asked for since.
   */
  async show(index) {
    const { scene } = this;
    const asked = (this.#asked += 1);
    const sweep = Math.min(scene.sweeps - 1, Math.max(0, Math.round(index)));
    if (!this.frame) setText(this.hint, "Loading the sweeps …");
    try {
      const next = scene.pairs.find((pair) => pair.source === sweep)?.target ?? sweep + 1;
      const wanted = [scene.sweep(sweep), next < scene.sweeps ? scene.sweep(next) : null, scene.pair(sweep)];
      const [source, target, pair] = await Promise.all(wanted);
      if (asked !== this.#asked || this.isClosed) return;
      this.#take(sweep, new Frame(source, target, pair));
      setText(this.hint, "");
    } catch (error) {
      if (asked === this.#asked && !this.isClosed)
        setText(this.hint, `Sweep ${sweep + 1} cannot be shown. ${error.message}`);
      return;
    }
    this.#prefetch(sweep + 1);
  }

  #take(sweep, frame) {
    const isFirst = this.frame === null;
    this.frame = frame;
    this.state.sweep = sweep;
    this.egos.learn(sweep, frame.pair);
    if (isFirst) this.#fit(frame.source);
    if (frame.pair && !this.#hadPair) this.#chooseColor();
    this.picture.takeFrame(frame);
    this.update();
    if (!isFirst) this.selection.renew();
    void this.#fetchEgos();
  }

  /** Fits the camera to points. */
  #fit(points) {
    Object.assign(this.camera, extent(points));
    this.camera.choose("free");
  }

  /** The color and the frame that suit the first flow. */
  #chooseColor() {
    this.#hadPair = true;
    this.state.color = this.frame.residual ? "residual" : "flow";
    this.state.ego = !this.frame.ego;
  }

  #prefetch(sweep) {
    if (sweep + 1 < this.scene.sweeps) this.scene.sweep(sweep + 1).catch(() => {});
    if (sweep < this.scene.sweeps) this.scene.pair(sweep).catch(() => {});
  }

  /** Fetches the ego motions that the paths need, unless the sequence plays. */
  async #fetchEgos() {
    const { sweep } = this.state;
    if (!this.state.hasTracks) return;
    const isWanted = () => !this.isClosed && !this.state.isPlaying && this.state.sweep === sweep;
    if (await this.egos.fetchBefore(sweep, isWanted)) this.redraw();
  }

  /** Shows what has become available since: flows, tracks, the dense cloud. */
  async reload() {
    if (this.scene.sweeps > 0) await this.show(this.state.sweep);
    await this.#loadRest();
  }

  async #loadRest() {
    const { scene, state } = this;
    const tracks = await scene.tracks().catch(() => []);
    if (this.isClosed) return;
    this.tracks = tracks;
    state.hasTracks = tracks.length > 0;
    this.update();
    this.hasDense = scene.hasDense ?? (await this.#readDense()) !== null;
    if (this.isClosed) return;
    if (state.mode === "dense") await this.showDense();
    this.update();
    await this.#fetchEgos();
  }

  async #readDense() {
    this.#denseArrays ??= await this.scene.dense().catch(() => null);
    return this.#denseArrays;
  }

  /** Loads the dense cloud, unless it is there. */
  async showDense() {
    if (!this.dense) {
      setText(this.hint, "Loading the dense cloud …");
      const arrays = await this.#readDense();
      if (this.isClosed) return;
      setText(this.hint, arrays ? "" : "There is no dense cloud.");
      if (!arrays) return;
      this.dense = new Dense(arrays);
      this.picture.takeDense(this.dense);
      if (!this.frame) this.#fit(this.dense.position);
    }
    this.update();
  }

  #repaint() {
    this.picture.readTheme();
    this.update();
  }

  /** Colors, objects and legend again, then a new picture. */
  update() {
    const { picture, state, frame, scene } = this;
    if (!picture) return;
    if (frame && !frame.has(state.color) && frame.pair) state.color = frame.residual ? "residual" : "flow";
    if (frame?.pair && !frame.ego) state.ego = true;
    this.objects = frame ? objectsOf(frame, this.tracks, state.sweep, picture.theme.isDark) : [];
    picture.paint();
    this.legend.show(legendOf(this), picture.theme);
    this.known = { hasTracks: state.hasTracks, hasDense: Boolean(this.hasDense), sweeps: scene.sweeps };
    this.redraw();
  }

  /** Draws at the display's next frame. */
  redraw() {
    if (this.#isDue || this.isClosed) return;
    this.#isDue = true;
    requestAnimationFrame((now) => {
      this.#isDue = false;
      if (this.isClosed) return;
      this.playback.advance(now);
      this.draw();
      if (this.state.isPlaying) this.redraw();
    });
  }

  /** Draws now. */
  draw() {
    const { picture, state, overlay } = this;
    if (!picture) return;
    const began = performance.now();
    const labels = picture.draw();
    if (this.scene.measure) picture.renderer.finish();
    state.lastFrameMs = performance.now() - began;
    overlay.show(labels, picture.view, picture.size);
    state.frames += 1;
    state.camera = this.camera.name;
    state.boxes = picture.boxPlaces();
    if (state.firstPictureMs === null && state.pointsDrawn > 0) state.firstPictureMs = performance.now() - this.#born;
    this.panel.update(state, this.frame, this.known ?? {});
    this.player.update(state, this.frame);
  }

  /** Ends the viewer and frees what it holds. */
  dispose() {
    this.#closing.abort();
    this.state.isPlaying = false;
    this.picture?.dispose();
    this.root.remove();
    if (this.host.viewer === this) delete this.host.viewer;
  }
}
