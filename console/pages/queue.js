/**
 * The queue, the devices and the nodes, as far as the caller may see them.
 */

import { json } from "../api.js";
import { el, fill, update } from "../dom.js";
import { count, duration, moment } from "../text.js";
import { repeat } from "./live.js";
import { sparkline } from "./sparkline.js";

/** Seconds between two updates. */
const INTERVAL = 2;

/** Number of updates that the lines show. */
const SHOWN = 60;

/** Shows the page. */
export async function queuePage(page, signal) {
  const history = [];
  const failure = el("div", { role: "alert" });
  const tiles = el("div", { class: "tiles" });
  const tables = el("div", {});
  fill(page, el("h1", {}, "Queue"), failure, tiles, tables);
  const load = async () => {
    const view = await json("/v1/queue", { signal });
    // The server has started again.
    if (history.length > 0 && pairsEnded(view) < history.at(-1).ended) history.length = 0;
    history.push({ at: performance.now(), queued: view.total.jobs, ended: pairsEnded(view) });
    if (history.length > SHOWN) history.shift();
    fill(failure);
    update(tiles, tilesOf(view, history));
    update(tables, tablesOf(view));
  };
  await repeat(INTERVAL, signal, load, (error) => update(failure, el("div", { class: "failure" }, error.message)));
}

/** All pairs that have ended on this node, where the caller may see their number. */
function pairsEnded(view) {
  return view.ended ? view.ended.reduce((sum, { pairs }) => sum + pairs, 0) : null;
}

function tile(name, value, detail, values = null) {
  return el("div", { class: "tile" }, el("span", { class: "name" }, name), el("strong", {}, value), el("span", { class: "detail" }, detail), values ? sparkline(values, name) : null);
}

function tilesOf(view, history) {
  const busy = Math.min(view.running.jobs, view.lanes);
  return [
    tile("Queued", count(view.total.jobs), `${duration(view.total.seconds)} of work`, history.map(({ queued }) => queued)),
    tile("Running", count(view.running.jobs), `${busy} of ${view.lanes} lanes`),
    tile("Left for all lanes", duration(view.lanes ? view.total.seconds / view.lanes : null), "predicted"),
    view.ended ? throughputTile(history) : null,
    view.ended ? endedTile(view) : null,
  ];
}

/** Pairs a minute, over the updates that are shown. */
function throughputTile(history) {
  const rates = history.slice(1).map((now, index) => {
    const before = history[index];
    return (60_000 * (now.ended - before.ended)) / (now.at - before.at);
  });
  const recent = rates.slice(-15);
  const mean = recent.reduce((sum, rate) => sum + rate, 0) / Math.max(1, recent.length);
  return tile("Throughput", count(mean), "pairs a minute on this node", rates);
}

function endedTile(view) {
  const failed = view.ended.filter(({ state }) => state !== "succeeded" && state !== "cancelled");
  const bad = failed.reduce((sum, { pairs }) => sum + pairs, 0);
  return tile("Ended", count(pairsEnded(view)), `pairs since this node's start, ${count(bad)} failed or expired`);
}

function table(title, names, rows, empty) {
  const head = el("thead", {}, el("tr", {}, names.map((name) => el("th", { scope: "col" }, name))));
  const cells = (row) => el("tr", {}, row.map((cell) => el("td", {}, cell)));
  const body = rows.length > 0 ? rows.map(cells) : el("tr", {}, el("td", { class: "empty", colspan: String(names.length) }, empty));
  return el("section", { class: "panel" }, el("h2", {}, title), el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": title }, el("table", {}, head, el("tbody", {}, body))));
}

function tablesOf(view) {
  const queued = view.queued.map((row) => [
    row.tenant,
    row.priority,
    row.device ?? "any",
    count(row.jobs),
    duration(row.seconds),
    duration(row.wait_seconds),
  ]);
  const tables = [table("Queued by tenant and priority", ["Tenant", "Priority", "Device", "Jobs", "Work", "One more would wait"], queued, "Nothing is queued.")];
  if (view.devices) {
    const devices = view.devices.map((device) => [device.name, device.kind, device.lanes, device.not_ready ?? el("span", { class: "state succeeded" }, "ready")]);
    tables.push(table("Devices of this node", ["Device", "Kind", "Lanes", "State"], devices, "This node computes nothing."));
  }
  if (view.nodes) {
    const nodes = view.nodes.map((node) => [
      node.is_this ? `${node.name} (this node)` : node.name,
      node.version,
      moment(node.started),
      node.devices.map((device) => `${device.kind} × ${device.lanes}`).join(", ") || "answers requests",
    ]);
    tables.push(table("Nodes", ["Node", "Version", "Started", "Devices"], nodes, "There are no nodes."));
  }
  return tables;
}
