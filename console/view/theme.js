/**
 * The colors of the page, for what is drawn.
 */

/**
 * Reads the colors of the theme from the custom properties of an element. Channels are 0 to 255.
 *
 * @param {HTMLElement} element
 * @returns {Object} `isDark`, `background`, `text`, `muted`, `accent`, `panel`, `border`, and the
 *   colors of points: `rest`, `source`, `target`; `measure` for the line of a distance.
 */
export function readTheme(element) {
  const style = getComputedStyle(element);
  const probe = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
  const isLight = matchMedia("(prefers-color-scheme: light)").matches;
  const read = (name, dark, light) => {
    probe.fillStyle = isLight ? light : dark;
    probe.fillStyle = style.getPropertyValue(name).trim() || probe.fillStyle;
    probe.fillRect(0, 0, 1, 1);
    return Array.from(probe.getImageData(0, 0, 1, 1).data.subarray(0, 3));
  };
  const background = read("--bg", "#0d141a", "#f5f7f9");
  const isDark = luma(background) < 128;
  return {
    isDark,
    background,
    text: read("--text", "#e6edf2", "#14222e"),
    muted: read("--muted", "#9fb0bd", "#51626f"),
    accent: read("--accent", "#6fd3c4", "#0b6b63"),
    panel: read("--panel", "#151f28", "#ffffff"),
    border: read("--border", "#2a3946", "#d3dbe1"),
    rest: isDark ? [104, 119, 131] : [138, 148, 158],
    source: isDark ? [92, 160, 236] : [28, 98, 190],
    target: isDark ? [58, 72, 84] : [192, 200, 207],
    measure: isDark ? [255, 126, 214] : [190, 24, 134],
  };
}

function luma([red, green, blue]) {
  return 0.299 * red + 0.587 * green + 0.114 * blue;
}

/** A color as CSS text. */
export function css([red, green, blue], alpha = 1) {
  return `rgb(${Math.round(red)} ${Math.round(green)} ${Math.round(blue)} / ${alpha})`;
}

/**
 * Calls `changed` when the theme of the page changes.
 *
 * @param {() => void} changed
 * @param {AbortSignal} signal Ends the watch.
 */
export function watchTheme(changed, signal) {
  const observer = new MutationObserver(changed);
  observer.observe(document.documentElement, { attributes: true, attributeFilter: ["data-theme", "class"] });
  signal.addEventListener("abort", () => observer.disconnect());
  for (const query of ["(prefers-color-scheme: dark)", "(prefers-contrast: more)"]) {
    matchMedia(query).addEventListener("change", changed, { signal });
  }
}
