/**
 * The page of one job: its progress, its life, and the viewer on its sweeps and flows.
 */

import { call, download, events, isShared, json, Refusal } from "../api.js";
import { button, el, fill, notice, progressBar, update } from "../dom.js";
import { openScene } from "../scene.js";
import { count, duration } from "../text.js";
import { createViewer } from "../viewer/viewer.js";
import { lifeOf } from "./life.js";
import { repeat } from "./live.js";

const ENDS = ["succeeded", "failed", "cancelled", "expired"];
/** Refusals after which the job cannot be followed any more; others pass. */
const FINAL = [401, 403, 404, 410];

/** Seconds between two looks at a queued job: how long it waits changes without an event. */
const LOOK_SECONDS = 3;

/** Shows the page of the job `id`. */
export async function jobPage(page, signal, id) {
  const path = `/v1/jobs/${encodeURIComponent(id)}`;
  const [job, info] = await Promise.all([json(path, { signal }), json("/v1/info", { signal })]);
  const parts = {
    head: el("div", { class: "job-head" }),
    host: el("div", { class: "viewer", data: { test: "viewer" } }),
    life: el("section", { class: "panel life", "aria-label": "The job" }),
    viewer: null,
  };
  fill(page, parts.head, parts.host, parts.life);
  const show = (job) => {
    update(parts.head, headOf(job, path, info));
    update(parts.life, lifeOf(job));
    void showPicture(parts, job, path, signal);
  };
  show(job);
  await follow(job, path, signal, parts, show);
}

/** Follows the events of a job until it ends. */
async function follow(job, path, signal, parts, show) {
  let latest = job;
  let asked = 0;
  let shown = 0;
  const take = (job, number) => {
    shown = number;
    latest = job;
    show(job);
  };
  const look = async () => {
    const number = (asked += 1);
    const job = await json(path, { signal });
    // An answer that comes late may be older than what is shown.
    if (number > shown) take(job, number);
  };
  const onEvent = (name, data) => {
    if (name === "progress") showProgress(parts.head, data);
    // The event of a sequence does not list its pairs, and that of a queued job not how long it waits.
    else if (data.kind === "sequence" || data.state === "queued") look().catch(() => {});
    else take(data, (asked += 1));
  };
  const lookAtQueued = () => (latest.state === "queued" ? look() : Promise.resolve());
  repeat(LOOK_SECONDS, signal, lookAtQueued, () => {}).catch(() => {});
  while (!signal.aborted && !ENDS.includes(latest.state)) {
    try {
      await events(`${path}/events`, signal, onEvent);
      await look();
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof Refusal && FINAL.includes(error.status)) throw error;
    }
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
}

/** Keeps the picture in step with the job: one drawing at a time, then the latest state of the job. */
async function showPicture(parts, job, path, signal) {
  parts.wanted = job;
  if (parts.isDrawing) return;
  parts.isDrawing = true;
  try {
    while (!signal.aborted && parts.drawn !== stamp(parts.wanted)) {
      const drawn = stamp(parts.wanted);
      await drawPicture(parts, path, signal);
      parts.drawn = drawn;
    }
  } catch (error) {
    if (signal.aborted) return;
    if (!parts.viewer) fill(parts.host, el("p", { class: "failure", role: "alert" }, error.message));
    else {
      // What is drawn stays.
      notice(error.message, "bad");
      setTimeout(() => void showPicture(parts, parts.wanted, path, signal), 1000 * LOOK_SECONDS);
    }
  } finally {
    parts.isDrawing = false;
  }
}

/** Creates the viewer, or tells it of new flows. */
async function drawPicture(parts, path, signal) {
  if (parts.viewer) {
    await parts.scene.refresh();
    await parts.viewer.reload();
    return;
  }
  parts.scene = await openScene(`${path}/scene`);
  if (signal.aborted) return;
  parts.viewer = createViewer(parts.host, parts.scene);
  signal.addEventListener("abort", () => parts.viewer.dispose());
}

/** What the picture depends on. */
function stamp(job) {
  return `${job.state} ${job.attempt} ${job.pairs?.ended ?? 0}`;
}

function headOf(job, path, info) {
  return [
    el(
      "div",
      { class: "title" },
      el("h1", {}, job.kind === "sequence" ? "Sequence" : "Pair"),
      el("code", { class: "id" }, job.id),
      job.trace_id ? el("code", { class: "id", title: "Trace" }, `trace ${job.trace_id}`) : null,
      el("span", { class: `state ${job.state}`, data: { test: "state" } }, job.state),
      job.dead_letter ? el("span", { class: "state failed" }, "given up") : null,
      el("div", { class: "actions" }, actionsOf(job, path, info)),
    ),
    progressOf(job),
    job.error ? el("div", { class: "failure", role: "alert" }, `${job.error.message} (${job.error.code})`) : null,
    (job.report?.warnings ?? []).map((text) => el("div", { class: "warning" }, text)),
  ];
}

/** The progress of a job that has not ended. */
function progressOf(job) {
  if (ENDS.includes(job.state)) return null;
  const bar = progressBar("Progress");
  const text = el("span", { data: { test: "progress-text" } });
  const box = el("div", { class: "progress", data: { test: "progress" } }, bar, text);
  if (job.pairs) {
    bar.value = job.pairs.ended / Math.max(1, job.pairs.total);
    text.textContent = `${job.pairs.ended} of ${job.pairs.total} pairs`;
  } else if (job.progress) setProgress(bar, text, job.progress);
  else text.textContent = job.state === "queued" ? waitOf(job.wait) : "starts";
  return box;
}

/** How long a queued job waits. */
function waitOf(wait) {
  if (!wait) return "waits for a device";
  const ahead = wait.ahead === null ? "10,000 or more jobs are" : wait.ahead === 1 ? "1 job is" : `${count(wait.ahead)} jobs are`;
  return `waits for a device: ${ahead} ahead, it starts in about ${duration(wait.seconds)}`;
}

function setProgress(bar, text, { done, total, loss }) {
  bar.value = total > 0 ? done / total : 0;
  text.textContent = `${count(done)} of ${count(total)}, loss ${loss.toFixed(4)} m`;
}

function showProgress(head, progress) {
  const box = head.querySelector(".progress");
  if (box) setProgress(box.querySelector("progress"), box.querySelector("span"), progress);
}

function actionsOf(job, path, info) {
  const hasEnded = ENDS.includes(job.state);
  const act = (method, target, done, then = () => {}) => async () => {
    try {
      await call(target, { method });
    } catch (error) {
      notice(error.message, "bad");
      return;
    }
    notice(done);
    then();
  };
  const actions = [];
  if (job.state === "succeeded") actions.push(downloads(job, path, info));
  if (isShared()) return actions;
  if (!hasEnded) {
    actions.push(button("Cancel", act("DELETE", path, "The job is being cancelled."), { data: { test: "cancel" } }));
  }
  if (hasEnded && job.state !== "succeeded") {
    const again = () => dispatchEvent(new HashChangeEvent("hashchange"));
    actions.push(button("Queue again", act("POST", job.links.requeue, "The job is queued again.", again), { data: { test: "requeue" } }));
  }
  if (job.state === "succeeded") actions.push(button("Share", () => void share(path), { data: { test: "share" } }));
  if (hasEnded) {
    const remove = act("DELETE", `${path}?remove=true`, "The job is removed.", () => (location.hash = "#/jobs"));
    const ask = () => confirm("Remove the job, its sweeps and its result?") && void remove();
    actions.push(button("Remove", ask, { class: "quiet", data: { test: "remove" } }));
  }
  return actions;
}

/** A menu with the result in each format. */
function downloads(job, path, info) {
  const isDense = Boolean(job.options?.densify);
  const archive = { media_type: "application/zip", extension: "zip" };
  const formats = job.kind === "pair" ? info.formats.flow : isDense ? [...info.formats.dense, archive] : [archive];
  const items = formats.map(({ media_type: type, extension }) =>
    button(`.${extension}`, () => download(`${path}/result`, type, `${job.id}.${extension}`), { class: "quiet" }),
  );
  if (job.kind === "sequence") {
    items.push(button("tracks", () => download(`${path}/tracks`, "application/json", `${job.id}.tracks.json`), { class: "quiet" }));
  }
  return el("details", { class: "menu", data: { test: "downloads" } }, el("summary", { class: "button" }, "Download"), el("div", {}, items));
}

/** Copies the text of an input. Pages without https have no clipboard but by a command. */
async function copy(input) {
  input.select();
  if (navigator.clipboard) await navigator.clipboard.writeText(input.value);
  else document.execCommand("copy");
}

/** Creates a link for readers without a key, and shows it. */
async function share(path) {
  const link = await json(`${path}/share`, { method: "POST" });
  const address = new URL(link.path, location.origin).href;
  const input = el("input", { type: "text", readonly: "", "aria-label": "Link", data: { test: "share-link" } });
  input.value = address;
  const words = link.expires_at
    ? `Whoever has this link can look at the job until ${new Date(link.expires_at).toLocaleString()}.`
    : "This server needs no key, so the link does not expire.";
  const copied = button("Copy", async () => {
    await copy(input);
    copied.textContent = "Copied";
  }, { class: "primary", data: { test: "copy" } });
  const dialog = el(
    "dialog",
    { "aria-label": "Share link", on: { close: () => dialog.remove() } },
    el("h2", {}, "Share link"),
    el("p", {}, words),
    input,
    el(
      "div",
      { class: "actions" },
      copied,
      button("Close", () => dialog.close()),
    ),
  );
  document.body.append(dialog);
  dialog.showModal();
  input.select();
}
