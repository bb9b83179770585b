/**
 * The page where files become a job: two sweeps or more, or a simulated street.
 */

import { buffer, json, Refusal, upload } from "../api.js";
import { button, el, field, fill, notice, progressBar, select } from "../dom.js";
import { bytes, count } from "../text.js";
import { optionsForm } from "./options.js";

/** Numbers of sweeps of the simulated street that can be chosen. */
const STREETS = [
  ["2", "2 sweeps: one pair"],
  ["5", "5 sweeps"],
  ["10", "10 sweeps, with tracks"],
];

/** Shows the page. */
export async function tryPage(page, signal) {
  const info = await json("/v1/info", { signal });
  const form = optionsForm(info.presets);
  const state = { files: [] };
  const chosen = el("ol", { class: "files", "aria-label": "Chosen sweeps" });
  const outcome = el("div", { class: "outcome", data: { test: "outcome" } });
  const send = button("Estimate the flow", () => void submit(state.files), {
    class: "primary",
    disabled: true,
    data: { test: "submit" },
  });
  const choose = (files) => {
    state.files = inOrder([...files]);
    fill(chosen, state.files.map((file) => el("li", {}, file.name, el("span", {}, bytes(file.size)))));
    send.disabled = state.files.length === 0;
    fill(outcome);
  };
  const submit = async (files) => {
    const bar = progressBar("Upload");
    send.disabled = true;
    fill(outcome, el("p", {}, "Sending …"), bar);
    try {
      const options = form.read();
      // The dense cloud is at the time of the sweep in the middle.
      if (options.densify) options.densify.reference_time = Math.floor((files.length - 1) / 2);
      const body = bodyOf(files, options);
      const job = await upload("/v1/jobs", body, (share) => (bar.value = share));
      const address = `#/jobs/${job.id}`;
      if (signal.aborted) notice(el("a", { href: address }, "The upload is complete: show the job"));
      else location.hash = address;
    } catch (error) {
      // The page is left: what is wrong is told at its edge.
      if (signal.aborted) throw error;
      send.disabled = files.length === 0;
      if (!(error instanceof Refusal)) throw error;
      fill(outcome, el("div", { class: "failure", role: "alert", data: { test: "refusal" } }, error.message));
    }
  };
  const street = async (sweeps) => {
    const seed = Math.floor(1000 * Math.random());
    const files = [];
    for (let index = 0; index < sweeps; index += 1) {
      if (signal.aborted) return;
      fill(outcome, el("p", {}, `Simulating sweep ${index + 1} of ${sweeps} …`));
      const sweep = await buffer(`/v1/street/${index}?seed=${seed}`);
      files.push(new File([sweep], `street_${String(index).padStart(4, "0")}.pcd`));
    }
    if (signal.aborted) return;
    choose(files);
    await submit(files);
  };
  fill(page, hero(), el("div", { class: "columns" }, dropPanel(choose, chosen, send, outcome, form), sidePanel(street, info)));
}

function hero() {
  return el(
    "section",
    { class: "hero" },
    el("h1", {}, "Two lidar sweeps in, the motion of every point out."),
    el("p", {}, "Drop the sweeps of a drive, or look at a simulated street first."),
  );
}

function dropPanel(choose, chosen, send, outcome, form) {
  const input = el("input", {
    type: "file",
    multiple: true,
    class: "visually-hidden",
    id: "files",
    data: { test: "files" },
    on: { change: () => choose(input.files) },
  });
  const zone = el(
    "div",
    {
      class: "drop",
      data: { test: "drop" },
      on: {
        dragover: (event) => {
          event.preventDefault();
          zone.classList.add("over");
        },
        dragleave: () => zone.classList.remove("over"),
        drop: (event) => {
          event.preventDefault();
          zone.classList.remove("over");
          choose(event.dataTransfer.files);
        },
      },
    },
    input,
    el("p", { class: "big" }, "Drop two sweeps or more here"),
    el("p", { class: "hint" }, "pcd, ply, npy, npz, las, KITTI bin, nuScenes pcd.bin, Argoverse feather"),
    el("label", { for: "files", class: "button" }, "Choose files"),
  );
  return el("section", { class: "panel", "aria-label": "Files" }, zone, chosen, form.element, el("div", { class: "actions" }, send), outcome);
}

function sidePanel(street, info) {
  const sweeps = select(STREETS, "2", () => {}, { data: { test: "street-sweeps" } });
  const start = button("Street", async () => {
    start.disabled = true;
    try {
      await street(Number(sweeps.value));
    } finally {
      start.disabled = false;
    }
  }, { class: "primary", data: { test: "street" } });
  const devices = info.devices.map((device) => `${device.kind} × ${device.lanes}`).join(", ");
  return el(
    "aside",
    { class: "side" },
    el(
      "section",
      { class: "panel" },
      el("h2", {}, "No data at hand?"),
      el("p", {}, "A simulated street: houses, parked and moving cars, cyclists and pedestrians, seen by a lidar with 64 beams."),
      field("Street", sweeps),
      el("div", { class: "actions" }, start),
    ),
    el(
      "section",
      { class: "panel" },
      el("h2", {}, "This server"),
      el(
        "dl",
        { class: "facts" },
        el("dt", {}, "Version"), el("dd", {}, info.version),
        el("dt", {}, "Devices"), el("dd", {}, devices || "other nodes"),
        el("dt", {}, "Points per sweep"), el("dd", {}, `at most ${count(info.limits.max_points)}`),
        el("dt", {}, "Upload"), el("dd", {}, `at most ${bytes(info.limits.max_upload_bytes)}`),
      ),
      el("p", {}, el("a", { href: "/docs/" }, "API reference")),
    ),
  );
}

/** The files in the order of the numbers in their names. */
function inOrder(files) {
  const collator = new Intl.Collator("en", { numeric: true });
  return files.sort((a, b) => collator.compare(a.name, b.name));
}

/** The form of a pair or of a sequence. One file is a pair in one file. */
function bodyOf(files, options) {
  const body = new FormData();
  body.append("options", JSON.stringify(options));
  const parts = files.length === 1 ? ["source"] : files.length === 2 && !options.densify ? ["source", "target"] : null;
  files.forEach((file, index) => body.append(parts ? parts[index] : "sweep", file, file.name));
  return body;
}
