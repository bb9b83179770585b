/**
 * Labels over the picture: texts at places of the scene, as elements.
 */

import { button, fill } from "../dom.js";
import { project } from "./matrix.js";

/** Largest number of labels. */
const MOST = 60;

/**
 * Shows labels.
 *
 * @param {HTMLElement} layer
 * @param {Array<{place: number[], text: string, color: number[], onClick: Function}>} labels
 * @param {Float32Array} view The camera's matrix.
 * @returns {Array<{x: number, y: number}|null>} Where each is shown, in pixels; null if it is not.
 */
export function showLabels(layer, labels, view) {
  const [width, height] = [layer.clientWidth, layer.clientHeight];
  const places = labels.slice(0, MOST).map(({ place }) => {
    const { x, y, w } = project(view, place, width, height);
    return w > 0 && x > 0 && x < width && y > 0 && y < height ? { x, y } : null;
  });
  while (layer.children.length > labels.length) layer.lastChild.remove();
  while (layer.children.length < labels.length) layer.append(button("", () => {}, { class: "fv-label", tabindex: "-1" }));
  labels.forEach(({ text, color, onClick }, index) => {
    const shown = layer.children[index];
    const place = places[index] ?? null;
    shown.hidden = place === null;
    if (!place) return;
    if (shown.textContent !== text) fill(shown, text);
    shown.onclick = onClick;
    shown.disabled = onClick === null;
    shown.style.transform = `translate(${place.x.toFixed(1)}px, ${place.y.toFixed(1)}px) translate(-50%, -140%)`;
    shown.style.borderColor = `rgb(${color.map(Math.round).join(" ")})`;
  });
  return places;
}
