/**
 * The life of a job: its times, attempts, phases, device and options.
 */

import { jobAddress } from "../api.js";
import { el } from "../dom.js";
import { between, count, duration, moment } from "../text.js";

/** Phases of a report in their order, with their names. */
const PHASES = [
  ["load", "load"],
  ["precompute", "ego motion and ground"],
  ["search", "object search"],
  ["query", "distance queries"],
  ["network", "network"],
];

/** The elements that describe a job. */
export function lifeOf(job) {
  return [
    el("h2", {}, "Life of the job"),
    phasesOf(job),
    el("div", { class: "columns" }, timesOf(job), resultOf(job), optionsOf(job)),
  ];
}

/** The wait and the phases of the estimate as one bar. */
function phasesOf(job) {
  const waited = between(job.created_at, job.started_at);
  const seconds = job.report?.seconds;
  if (waited === null || typeof seconds !== "object") return null;
  const phases = [["queue", waited]];
  for (const [name, text] of PHASES) {
    if (seconds[name]) phases.push([text, seconds[name]]);
  }
  const named = phases.reduce((sum, [, value]) => sum + value, 0) - waited;
  const rest = seconds.total - named;
  if (rest > 0.001) phases.push(["rest", rest]);
  const all = phases.reduce((sum, [, value]) => sum + value, 0);
  const text = (name, value) => `${name} ${duration(value)}`;
  const parts = phases.map(([name, value], index) => {
    const part = el("span", { class: `phase p${index}`, title: text(name, value) });
    part.style.flexGrow = String(Math.max(value / all, 0.004));
    return part;
  });
  const legend = phases.map(([name, value], index) => el("li", {}, el("i", { class: `phase p${index}` }), text(name, value)));
  return el("div", {}, el("div", { class: "phases", role: "img", "aria-label": phases.map((p) => text(...p)).join(", ") }, parts), el("ul", { class: "legend" }, legend));
}

function facts(title, rows) {
  const shown = rows.filter(([, value]) => value !== null && value !== undefined && value !== "");
  return el("div", {}, el("h3", {}, title), el("dl", { class: "facts" }, shown.map(([name, value]) => [el("dt", {}, name), el("dd", {}, value)])));
}

function timesOf(job) {
  return facts("Times", [
    ["Accepted", moment(job.created_at)],
    ["Started", job.started_at ? moment(job.started_at) : null],
    ["Ended", job.finished_at ? moment(job.finished_at) : null],
    ["Ran", job.finished_at && job.started_at ? duration(between(job.started_at, job.finished_at)) : null],
    ["Deadline", job.deadline ? moment(job.deadline) : null],
    ["Attempts", job.attempt],
    ["Pairs", job.pairs ? `${job.pairs.ended} of ${job.pairs.total}` : null],
    ["In the log", el("code", {}, `job=${job.id}`)],
  ]);
}

function resultOf(job) {
  const { report } = job;
  if (!report) return facts("Result", [["State", job.state], ["Pairs", pairLinks(job)]]);
  const motion = report.ego_motion;
  const metres = (value) => value.toFixed(3);
  return facts("Result", [
    ["Points", report.points === undefined ? null : count(report.points)],
    ["Stop reason", report.stop_reason],
    ["Device", report.device],
    ["Clusters", report.objects ? `${count(report.objects.clusters)}, of which ${report.objects.moving} move` : null],
    ["Iterations", report.field ? `${report.field.iterations} of ${report.field.max_iterations}` : null],
    ["Overlap", report.overlap ? `${Math.round(100 * report.overlap)}%` : null],
    ["Ego motion", motion ? `${metres(motion[0][3])}, ${metres(motion[1][3])}, ${metres(motion[2][3])} m` : null],
    ["Between sweeps", report.dt_s ? `${report.dt_s} s${report.dt_assumed ? ", assumed" : ""}` : null],
    ["Pairs", pairLinks(job)],
  ]);
}

/** Links to the pairs of a sequence that have not succeeded: those that somebody looks for. */
function pairLinks(job) {
  const pairs = (job.pairs?.jobs ?? []).filter((pair) => ["failed", "cancelled", "expired"].includes(pair.state));
  if (pairs.length === 0) return null;
  return el("span", {}, pairs.map((pair, index) => [index > 0 ? ", " : "", el("a", { href: jobAddress(pair.id) }, pair.state)]));
}

function optionsOf(job) {
  const { labels = {}, ...options } = job.options ?? {};
  const named = Object.entries(labels).map(([name, value]) => el("span", { class: "label", data: { test: "label" } }, `${name}=${value}`));
  const rows = Object.entries(options).map(([name, value]) => [name, typeof value === "object" ? JSON.stringify(value) : String(value)]);
  return facts("Options", [...rows, ["labels", named.length > 0 ? el("span", {}, named) : null]]);
}
