/**
 * The jobs of the caller, latest first, by state and label.
 */

import { call, json, Refusal } from "../api.js";
import { button, el, field, fill, notice, select, update } from "../dom.js";
import { between, duration, moment, shortId } from "../text.js";
import { repeat } from "./live.js";

const STATES = ["", "queued", "running", "succeeded", "failed", "cancelled", "expired"];

/** Number of jobs on a page. */
const PAGE = 50;

/** Seconds between two updates of the first page. */
const INTERVAL = 3;

/** Shows the page. */
export async function jobsPage(page, signal) {
  const state = { state: "", label: "", before: [], next: null };
  const body = el("tbody", { data: { test: "jobs" } });
  const failure = el("div", { role: "alert" });
  const older = button("Older", () => void turn(state.next), { data: { test: "older" } });
  const newer = button("Newer", () => void turn(null), { data: { test: "newer" } });
  let asked = 0;
  const load = async () => {
    const number = (asked += 1);
    older.disabled = true;
    const query = new URLSearchParams({ limit: String(PAGE) });
    if (state.state) query.set("state", state.state);
    if (state.label) query.set("label", state.label);
    const before = state.before.at(-1);
    if (before) query.set("before", before);
    const { jobs, next } = await json(`/v1/jobs?${query}`, { signal });
    // Another page was asked for meanwhile.
    if (number !== asked) return;
    state.next = next;
    older.disabled = next === null;
    newer.disabled = state.before.length === 0;
    fill(failure);
    update(body, jobs.length > 0 ? jobs.map((job) => rowOf(job, load)) : emptyRow(state));
  };
  const failed = (error) => {
    older.disabled = state.next === null;
    update(failure, el("div", { class: "failure" }, error.message));
  };
  const turn = (next) => {
    if (next) state.before.push(next);
    else state.before.pop();
    return load().catch(failed);
  };
  const filter = (name, value) => {
    state[name] = value;
    state.before = [];
    load().catch(failed);
  };
  const states = select(STATES.map((name) => [name, name || "any"]), "", (value) => filter("state", value), { data: { test: "filter-state" } });
  const label = el("input", {
    type: "search",
    placeholder: "name=value",
    data: { test: "filter-label" },
    on: { change: () => filter("label", label.value.trim()) },
  });
  fill(
    page,
    el("h1", {}, "Jobs"),
    el("div", { class: "filters" }, field("State", states), field("Label", label)),
    failure,
    el("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Jobs" }, el("table", {}, headOf(), body)),
    el("div", { class: "actions" }, newer, older),
  );
  await repeat(INTERVAL, signal, () => (state.before.length === 0 ? load() : Promise.resolve()), failed);
}

function headOf() {
  const names = ["Job", "Kind", "State", "Accepted", "Took", "Method", "Labels", ""];
  return el("thead", {}, el("tr", {}, names.map((name) => (name ? el("th", { scope: "col" }, name) : el("td")))));
}

function emptyRow(state) {
  const words = state.state || state.label ? "No job matches." : "There are no jobs yet.";
  return el("tr", {}, el("td", { colspan: "8", class: "empty" }, words));
}

function rowOf(job, reload) {
  const labels = Object.entries(job.options?.labels ?? {});
  return el(
    "tr",
    { data: { id: job.id } },
    el("td", {}, el("a", { href: `#/jobs/${job.id}`, title: job.id }, shortId(job.id))),
    el("td", {}, job.pairs ? `${job.pairs.total} pairs` : job.kind),
    el("td", {}, el("span", { class: `state ${job.state}` }, job.state), progressOf(job)),
    el("td", {}, moment(job.created_at)),
    el("td", {}, duration(between(job.started_at, job.finished_at))),
    el("td", {}, job.options?.preset ?? ""),
    el("td", {}, labels.map(([name, value]) => el("span", { class: "label" }, `${name}=${value}`))),
    el("td", { class: "row-actions" }, actionOf(job, reload)),
  );
}

function progressOf(job) {
  if (job.state !== "running") return null;
  if (job.pairs) return ` ${job.pairs.ended} of ${job.pairs.total}`;
  return job.progress ? ` ${Math.round((100 * job.progress.done) / Math.max(1, job.progress.total))}%` : null;
}

/** The button that ends or repeats a job. */
function actionOf(job, reload) {
  const act = (method, path) => async () => {
    try {
      await call(path, { method });
      await reload();
    } catch (error) {
      if (!(error instanceof Refusal)) throw error;
      notice(error.message, "bad");
    }
  };
  if (job.state === "queued" || job.state === "running") return button("Cancel", act("DELETE", job.links.self), { class: "quiet", data: { test: "row-cancel" } });
  if (job.state === "succeeded") return null;
  return button("Queue again", act("POST", job.links.requeue), { class: "quiet", data: { test: "row-requeue" } });
}
