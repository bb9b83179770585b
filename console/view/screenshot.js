/**
 * Saves the picture with its labels and legend as PNG.
 */

import { make } from "./elements.js";
import { css } from "./theme.js";

/** Time after which the address of a saved picture is given back, milliseconds. */
const KEPT_MS = 30000;

/**
 * Puts the parts of a picture together and offers them as a download. The canvas has to be drawn in
 * the same task.
 *
 * @param {HTMLCanvasElement} canvas
 * @param {{legend: HTMLCanvasElement, labels: Object[], theme: Object, name: string}} parts `labels`
 *   as `Overlay.shown` holds them, `name` of the file without its ending.
 * @returns {Promise<void>}
 */
export async function saveScreenshot(canvas, { legend, labels, theme, name }) {
  const picture = make("canvas");
  [picture.width, picture.height] = [canvas.width, canvas.height];
  const pen = picture.getContext("2d");
  pen.drawImage(canvas, 0, 0);
  const ratio = canvas.width / canvas.clientWidth;
  pen.scale(ratio, ratio);
  const font = getComputedStyle(canvas).fontFamily;
  for (const label of labels) drawLabel(pen, label, theme, font);
  const [width, height] = [parseFloat(legend.style.width), parseFloat(legend.style.height)];
  if (width > 0) pen.drawImage(legend, 12, canvas.clientHeight - height - 12, width, height);
  const blob = await new Promise((resolve) => picture.toBlob(resolve, "image/png"));
  const address = URL.createObjectURL(blob);
  make("a", { href: address, download: `${name.replace(/[^\w.-]+/g, "_")}.png` }).click();
  setTimeout(() => URL.revokeObjectURL(address), KEPT_MS);
}

function drawLabel(pen, { x, y, text, color, kind }, theme, font) {
  if (kind === "mark") {
    pen.strokeStyle = css(theme.measure);
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(x, y, 7, 0, 2 * Math.PI);
    pen.stroke();
    return;
  }
  pen.font = `${kind === "ring" ? 11 : 12}px ${font}`;
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  if (kind !== "ring") {
    const width = pen.measureText(text).width + 12;
    pen.fillStyle = css(theme.panel, 0.92);
    pen.strokeStyle = css(color ?? theme.measure);
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.roundRect(x - width / 2, y - 10, width, 20, 5);
    pen.fill();
    pen.stroke();
  }
  pen.fillStyle = css(kind === "ring" ? theme.muted : theme.text);
  pen.fillText(text, x, y);
}
