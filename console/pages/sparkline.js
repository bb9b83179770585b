/**
 * Small lines without axes.
 */

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT] = [160, 36];

/**
 * A line over the latest values.
 *
 * @param {number[]} values
 * @param {string} name What the values are, for screen readers.
 */
export function sparkline(values, name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
  svg.setAttribute("class", "sparkline");
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", `${name}, latest values`);
  if (values.length > 1) {
    const most = Math.max(...values, 1);
    const x = (index) => (WIDTH * index) / (values.length - 1);
    const y = (value) => HEIGHT - 2 - ((HEIGHT - 4) * value) / most;
    const line = document.createElementNS(SVG, "polyline");
    line.setAttribute("points", values.map((value, index) => `${x(index).toFixed(1)},${y(value).toFixed(1)}`).join(" "));
    svg.append(line);
  }
  return svg;
}
