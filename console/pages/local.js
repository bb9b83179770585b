/**
 * The page of `fnsf view`: files of this machine, without a service.
 */

import { el, fill } from "../dom.js";
import { openScene } from "../scene.js";
import { createViewer } from "../viewer/viewer.js";

/** Shows the page. */
export async function localPage(page, signal) {
  const scene = await openScene("/view/scene");
  const host = el("div", { class: "viewer whole" });
  fill(page, el("h1", { class: "visually-hidden" }, scene.name), host);
  const viewer = createViewer(host, scene);
  signal.addEventListener("abort", () => viewer.dispose());
}
