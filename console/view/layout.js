/**
 * The elements of a viewer: its canvas and what lies over it.
 */

import { Card } from "./card.js";
import { make } from "./elements.js";
import { Legend } from "./legend.js";
import { Overlay } from "./overlay.js";
import { Panel } from "./panel.js";
import { Player } from "./player.js";

/** Width below which the panel begins collapsed, pixels. */
const NARROW_PX = 640;

const HELP =
  "Point cloud in 3-D. Drag or arrow keys turn, the wheel or plus and minus zoom, " +
  "a click shows numbers, space plays.";

/**
 * Builds the elements, appends them to the host and sets them as fields of the viewer.
 *
 * @param {Viewer} viewer
 */
export function buildLayout(viewer) {
  const { commands, host, scene, selection } = viewer;
  viewer.canvas = make("canvas", {
    class: "fv-canvas",
    test: "view-canvas",
    tabindex: 0,
    role: "application",
    "aria-label": HELP,
  });
  viewer.overlay = new Overlay((object) => selection.chooseObject(object));
  viewer.legend = new Legend();
  viewer.card = new Card(() => selection.clear());
  viewer.panel = new Panel(commands);
  viewer.player = new Player(scene, commands);
  viewer.hint = make("p", { class: "fv-hint", role: "status" });
  viewer.live = make("p", { class: "fv-live", role: "status" });
  viewer.root = make(
    "div",
    { class: "fv-root" },
    viewer.canvas,
    viewer.overlay.element,
    viewer.legend.element,
    viewer.card.element,
    viewer.hint,
    viewer.player.element,
    viewer.panel.element,
    viewer.live,
  );
  host.append(viewer.root);
  viewer.panel.collapse(viewer.root.clientWidth < NARROW_PX);
}
