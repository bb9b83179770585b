/**
 * The legend: what the colors of points and layers mean. It is drawn on a canvas of its own, so that
 * screenshots show it too.
 */

import { hue, idColor, mix, ramp } from "./colors.js";
import { MOVING_COLOR } from "./dense.js";
import { make } from "./elements.js";
import { css } from "./theme.js";

const WIDTH = 172;
const PAD = 10;
const WHEEL_PX = 96;
const LINE_PX = 17;
const BAR_PX = 10;

/** The legend of a viewer. */
export class Legend {
  #drawn = "";

  constructor() {
    this.element = make("canvas", { class: "fv-legend", role: "img", "aria-label": "Legend" });
  }

  /**
   * Draws the legend, unless it shows this already.
   *
   * @param {Object} content `title`, `wheel` (`{scale, dt}`: metres and seconds) or `bar` (`{from, to}`,
   *   texts) or `ids` (a text) or none, `keys` (`[color, text]` of layers).
   * @param {Object} theme
   */
  show(content, theme) {
    const wanted = JSON.stringify([content, theme, devicePixelRatio]);
    if (wanted === this.#drawn) return;
    this.#drawn = wanted;
    const { element } = this;
    const height = heightOf(content);
    const ratio = Math.max(1, devicePixelRatio);
    [element.width, element.height] = [WIDTH * ratio, height * ratio];
    [element.style.width, element.style.height] = [`${WIDTH}px`, `${height}px`];
    element.setAttribute("aria-label", `Legend. ${inWords(content)}`);
    const pen = element.getContext("2d");
    pen.scale(ratio, ratio);
    draw(pen, content, theme, height, getComputedStyle(element).fontFamily);
  }
}

function heightOf({ wheel, bar, ids, keys }) {
  const body = wheel ? WHEEL_PX + 40 + 2 * LINE_PX : bar ? BAR_PX + 22 : ids ? BAR_PX + 22 : 0;
  return 2 * PAD + LINE_PX + body + keys.length * LINE_PX;
}

function inWords({ title, wheel, bar, ids, keys }) {
  const scale = wheel && `hue is the direction, forward is red; full color at ${scaleText(wheel)}`;
  return [title, scale, bar && `from ${bar.from} to ${bar.to}`, ids, ...keys.map(([, text]) => text)]
    .filter(Boolean)
    .join("; ");
}

function scaleText({ scale, dt }) {
  return `${tidy(scale / dt)} m/s, ${tidy(scale)} m`;
}

function tidy(value) {
  return String(Number(value.toPrecision(3)));
}

function draw(pen, content, theme, height, font) {
  pen.fillStyle = css(theme.panel, 0.9);
  pen.strokeStyle = css(theme.border);
  pen.beginPath();
  pen.roundRect(0.5, 0.5, WIDTH - 1, height - 1, 9);
  pen.fill();
  pen.stroke();
  pen.textBaseline = "middle";
  const write = (text, x, y, { weight = 400, color = theme.text, align = "left" } = {}) => {
    pen.font = `${weight} 12px ${font}`;
    pen.fillStyle = css(color);
    pen.textAlign = align;
    pen.fillText(text, x, y, WIDTH - PAD - (align === "left" ? x : PAD));
  };
  write(content.title, PAD, PAD + LINE_PX / 2, { weight: 600 });
  let y = PAD + LINE_PX + 4;
  if (content.wheel) y = drawWheel(pen, content.wheel, theme, write, y);
  else if (content.bar) y = drawBar(pen, content.bar, theme, write, y);
  else if (content.ids) y = drawIds(pen, content.ids, theme, write, y);
  for (const [color, text] of content.keys) {
    pen.fillStyle = css(color);
    pen.beginPath();
    pen.arc(PAD + 5, y + LINE_PX / 2 - 2, 4, 0, 2 * Math.PI);
    pen.fill();
    write(text, PAD + 17, y + LINE_PX / 2 - 2, { color: theme.muted });
    y += LINE_PX;
  }
}

/** The wheel as seen from above: forward is up, left is left. */
function drawWheel(pen, wheel, theme, write, top) {
  const [x, y, radius] = [WIDTH / 2, top + 16 + WHEEL_PX / 2, WHEEL_PX / 2];
  pen.drawImage(wheelImage(theme.rest), x - radius, y - radius, WHEEL_PX, WHEEL_PX);
  const muted = { color: theme.muted, align: "center" };
  write("forward", x, top + 7, muted);
  write("left", x - radius - 15, y, muted);
  write("right", x + radius + 17, y, muted);
  write("full color at", x, y + radius + 12, muted);
  write(scaleText(wheel), x, y + radius + 12 + LINE_PX, { weight: 600, align: "center" });
  return top + WHEEL_PX + 34 + 2 * LINE_PX;
}

/** The wheel in twice the size at which it is drawn. */
function wheelImage(rest) {
  const image = make("canvas", { width: 2 * WHEEL_PX, height: 2 * WHEEL_PX });
  const pen = image.getContext("2d");
  const pixels = pen.createImageData(image.width, image.height);
  for (let at = 0; at < image.width * image.height; at += 1) {
    const forward = 1 - (Math.floor(at / image.width) + 0.5) / WHEEL_PX;
    const left = 1 - ((at % image.width) + 0.5) / WHEEL_PX;
    const length = Math.hypot(forward, left);
    const color = mix(rest, hue(Math.atan2(left, forward) / (2 * Math.PI)), Math.min(1, length));
    pixels.data.set([...color, 255 * Math.min(1, Math.max(0, (1 - length) * WHEEL_PX))], 4 * at);
  }
  pen.putImageData(pixels, 0, 0);
  return image;
}

function drawBar(pen, { from, to, isMoving }, theme, write, top) {
  const shade = pen.createLinearGradient(PAD, 0, WIDTH - PAD, 0);
  for (let at = 0; at <= 8; at += 1) {
    const color = isMoving ? mix(theme.rest, MOVING_COLOR, at / 8) : ramp(at / 8, theme.isDark);
    shade.addColorStop(at / 8, css(color));
  }
  pen.fillStyle = shade;
  pen.fillRect(PAD, top, WIDTH - 2 * PAD, BAR_PX);
  write(from, PAD, top + BAR_PX + 9, { color: theme.muted });
  write(to, WIDTH - PAD, top + BAR_PX + 9, { color: theme.muted, align: "right" });
  return top + BAR_PX + 20;
}

function drawIds(pen, text, theme, write, top) {
  const parts = 10;
  const width = (WIDTH - 2 * PAD) / parts;
  for (let id = 0; id < parts; id += 1) {
    pen.fillStyle = css(idColor(id, theme.isDark));
    pen.fillRect(PAD + id * width, top, width, BAR_PX);
  }
  write(text, PAD, top + BAR_PX + 9, { color: theme.muted });
  return top + BAR_PX + 20;
}
