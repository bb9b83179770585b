/**
 * Labels and marks over the canvas.
 */

import { make, setText } from "./elements.js";
import { project } from "./matrix.js";
import { css } from "./theme.js";

/** Height of a label and width of its letters, pixels, to keep labels apart. */
const HEIGHT_PX = 21;
const LETTER_PX = 7;

/** The layer of labels. Its elements are used again from picture to picture. */
export class Overlay {
  #buttons = [];
  #texts = [];
  #marks = [];

  /** @param {(object: Object) => void} chosen Called with the object whose label is pressed. */
  constructor(chosen) {
    this.chosen = chosen;
    this.element = make("div", { class: "fv-overlay" });
    /** What the last picture shows: `{x, y, text, color, kind}`, for screenshots. */
    this.shown = [];
  }

  /**
   * Shows labels and marks.
   *
   * @param {Object} content `objects` (`{place, text, object, isPicked}`), `texts` (`{place, text,
   *   kind}`, kind "ring" or "distance"), `marks` (places). Places in metres.
   * @param {Float32Array} view
   * @param {{width: number, height: number}} size Pixels.
   */
  show({ objects, texts, marks }, view, size) {
    this.shown = [];
    const inside = ({ x, y, depth }) => depth > 0 && x > 0 && y > 0 && x < size.width && y < size.height;
    const placed = (items) => items.map((item) => ({ ...item, ...project(view, item.place, size) })).filter(inside);
    const order = (a, b) => Number(b.isPicked) - Number(a.isPicked) || a.depth - b.depth;
    const labels = apart(placed(objects).sort(order));
    this.#fill(
      this.#buttons,
      labels,
      () => this.#button(),
      (button, label) => {
        button.owner = label.object;
        setText(button, label.text);
        button.style.borderColor = css(label.object.color);
        button.classList.toggle("fv-picked", label.isPicked);
      },
    );
    const plain = placed(texts);
    this.#fill(
      this.#texts,
      plain,
      () => make("span", { "aria-hidden": "true" }),
      (span, text) => {
        setText(span, text.text);
        span.className = `fv-${text.kind}`;
      },
    );
    this.#fill(
      this.#marks,
      placed(marks.map((place) => ({ place }))),
      () => make("span", { class: "fv-mark", "aria-hidden": "true" }),
      () => {},
    );
    this.shown = [
      ...labels.map(({ x, y, text, object }) => ({
        x,
        y: y - HEIGHT_PX / 2,
        text,
        color: object.color,
        kind: "object",
      })),
      ...plain.map(({ x, y, text, kind }) => ({ x, y, text, kind })),
      ...placed(marks.map((place) => ({ place }))).map(({ x, y }) => ({ x, y, text: "", kind: "mark" })),
    ];
  }

  #button() {
    const button = make("button", { type: "button", class: "fv-label", title: "Show the numbers of this object" });
    button.addEventListener("click", () => this.chosen(button.owner));
    return button;
  }

  #fill(pool, items, create, write) {
    while (pool.length < items.length) {
      pool.push(create());
      this.element.append(pool[pool.length - 1]);
    }
    pool.forEach((element, at) => {
      element.hidden = at >= items.length;
      if (element.hidden) return;
      write(element, items[at]);
      element.style.translate = `${items[at].x.toFixed(1)}px ${items[at].y.toFixed(1)}px`;
    });
  }
}

/** The labels that do not cover an earlier one. */
function apart(labels) {
  const kept = [];
  for (const label of labels) {
    const width = (other) => (LETTER_PX * (label.text.length + other.text.length)) / 2 + 12;
    const isFree = kept.every(
      (other) => Math.abs(other.x - label.x) > width(other) || Math.abs(other.y - label.y) > HEIGHT_PX,
    );
    if (isFree || label.isPicked) kept.push(label);
  }
  return kept;
}
