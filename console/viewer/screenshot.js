/**
 * Saves the picture with its labels and its legend.
 */

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
  const put = (element, size) => {
    const box = element.getBoundingClientRect();
    context.font = `${size * scale}px ${style.fontFamily}`;
    context.fillText(element.textContent, (box.left - outer.left) * scale, (box.top - outer.top) * scale);
  };
  for (const label of host.querySelectorAll(".fv-label:not([hidden])")) put(label, 12);
  for (const text of host.querySelectorAll(".fv-legend p")) put(text, 12);
  for (const image of host.querySelectorAll(".fv-legend canvas")) {
    const box = image.getBoundingClientRect();
    context.drawImage(image, (box.left - outer.left) * scale, (box.top - outer.top) * scale, box.width * scale, box.height * scale);
  }
  picture.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${name}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  });
}
