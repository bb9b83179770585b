/**
 * The page of `fnsf view`: files of this machine, without a service.
 */

import { el, fill } from "../dom.js";
import { openScene } from "../scene.js";
import { createViewer } from "../viewer/viewer.js";

/** Shows the page. The secret is that of the address. */
export async function localPage(page, signal, secret) {
  const scene = await openScene(`/view/${secret}/scene`);
  if (signal.aborted) return;
  const host = el("div", { class: "viewer whole" });
  fill(page, el("h1", { class: "visually-hidden" }, scene.name), host);
  const viewer = createViewer(host, scene);
  signal.addEventListener("abort", () => viewer.dispose());
}
