/**
 * Saves the picture with its labels and its legend.
 */

import { saveAs } from "../api.js";

/** Size of texts, pixels of the page. */
const TEXT_SIZE = 12;

/**
 * Draws the canvas, the labels and the legend into one picture and offers it as a file.
 *
 * @param {HTMLCanvasElement} canvas Drawn in the same task.
 * @param {HTMLElement} host The element that holds labels and legend.
 * @param {string} name The name of the file, without its ending.
 */
export function saveScreenshot(canvas, host, name) {
  const picture = document.createElement("canvas");
  [picture.width, picture.height] = [canvas.width, canvas.height];
  const context = picture.getContext("2d");
  context.drawImage(canvas, 0, 0);
  const outer = host.getBoundingClientRect();
  const scale = canvas.width / outer.width;
  const style = getComputedStyle(host);
  context.textBaseline = "top";
  context.fillStyle = style.color;
  context.font = `${TEXT_SIZE * scale}px ${style.fontFamily}`;
  const put = (text) => {
    const range = document.createRange();
    range.selectNodeContents(text);
    // A text that is hidden has no place.
    const box = range.getClientRects()[0];
    if (box) context.fillText(text.data, (box.left - outer.left) * scale, (box.top - outer.top) * scale);
  };
  for (const shown of host.querySelectorAll(".fv-labels, .fv-legend")) {
    const texts = document.createTreeWalker(shown, NodeFilter.SHOW_TEXT);
    while (texts.nextNode()) put(texts.currentNode);
  }
  for (const image of host.querySelectorAll(".fv-legend canvas")) {
    const box = image.getBoundingClientRect();
    context.drawImage(image, (box.left - outer.left) * scale, (box.top - outer.top) * scale, box.width * scale, box.height * scale);
  }
  picture.toBlob((blob) => saveAs(blob, `${name}.png`));
}
