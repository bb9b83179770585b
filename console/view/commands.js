/**
 * What controls and keys do.
 */

import { saveScreenshot } from "./screenshot.js";

const ARROWS = { ArrowLeft: [0.08, 0], ArrowRight: [-0.08, 0], ArrowUp: [0, 0.06], ArrowDown: [0, -0.06] };
const CAMERAS = { 1: "free", 2: "top", 3: "side", 4: "driver" };
const ZOOM = 0.85;

/**
 * The commands of a viewer.
 *
 * @param {Viewer} viewer
 * @returns {Object} As `Panel` and `Player` take them.
 */
export function commandsOf(viewer) {
  const { state } = viewer;
  return {
    set(name, value) {
      state[name] = value;
      if (name === "mode") setMode(viewer);
      else if (name === "ego") viewer.picture?.takeMotion(viewer.frame);
      viewer.update();
    },
    layer(name, isOn) {
      state.layers[name] = isOn;
      viewer.update();
    },
    camera(name) {
      viewer.camera.choose(name);
      viewer.redraw();
    },
    fit() {
      viewer.camera.choose(viewer.camera.name);
      viewer.redraw();
    },
    measure: () => viewer.selection.setMeasuring(!state.isMeasuring),
    play: () => viewer.playback.set(!state.isPlaying),
    speed(factor) {
      state.speed = factor;
    },
    time(share) {
      viewer.playback.set(false);
      state.time = share;
      viewer.redraw();
    },
    sweep(index) {
      if (index < 0 || index >= viewer.scene.sweeps) return;
      viewer.playback.set(false);
      void viewer.show(index);
    },
    screenshot() {
      viewer.draw();
      const { legend, overlay, picture, scene } = viewer;
      const parts = {
        legend: legend.element,
        labels: overlay.shown,
        theme: picture.theme,
        name: `${scene.name}_${state.sweep + 1}`,
      };
      void saveScreenshot(viewer.canvas, parts);
    },
  };
}

function setMode(viewer) {
  viewer.playback.set(false);
  viewer.selection.clear();
  if (viewer.state.mode === "dense") void viewer.showDense();
}

/**
 * Does what a key on the canvas means.
 *
 * @param {Viewer} viewer
 * @param {KeyboardEvent} event
 * @returns {boolean} Whether the key means something.
 */
export function pressKey(viewer, event) {
  const { camera, commands, state } = viewer;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  const sweepBy = { "[": -1, "]": 1 }[key] ?? (event.shiftKey && { ArrowLeft: -1, ArrowRight: 1 }[key]);
  if (sweepBy) commands.sweep(state.sweep + sweepBy);
  else if (ARROWS[key]) camera.turn(...ARROWS[key]);
  else if (key === "+" || key === "=") camera.zoom(ZOOM);
  else if (key === "-") camera.zoom(1 / ZOOM);
  else if (CAMERAS[key]) commands.camera(CAMERAS[key]);
  else if (key === "f") commands.fit();
  else if (key === " ") commands.play();
  else if (key === "m") commands.measure();
  else if (key === "Escape") viewer.selection.clear();
  else return false;
  viewer.redraw();
  return true;
}
