/**
 * The console: chooses the page by the address, and keeps the key and the theme.
 */

import { isShared, key, Refusal, setKey, useShareToken } from "./api.js";
import { button, el, field, fill, notice } from "./dom.js";
import { jobPage } from "./pages/job.js";
import { jobsPage } from "./pages/jobs.js";
import { queuePage } from "./pages/queue.js";
import { tryPage } from "./pages/try.js";
import { localPage } from "./pages/local.js";
import { shortId } from "./text.js";

const PAGES = [
  { address: "#/", text: "Try it" },
  { address: "#/jobs", text: "Jobs" },
  { address: "#/queue", text: "Queue" },
];

/** Ends the page that is shown: its timers, streams and viewer. */
let leave = () => {};

/** The page of an address, as `[function, argument, title]`. */
function pageOf(path) {
  const [, first, second] = path.split("/");
  if (first === "jobs" && second) return [jobPage, second, `Job ${shortId(second)}`];
  if (first === "jobs") return [jobsPage, null, "Jobs"];
  if (first === "queue") return [queuePage, null, "Queue"];
  if (first === "view") return [localPage, second, "Files"];
  return [tryPage, null, "Try it"];
}

async function show() {
  leave();
  const [path, query] = location.hash.replace(/^#/, "").split("?");
  useShareToken(new URLSearchParams(query ?? "").get("token"));
  const page = document.getElementById("page");
  const closing = new AbortController();
  leave = () => closing.abort();
  const isLocal = path.startsWith("/view");
  showHeader(path, isLocal);
  fill(page, el("p", { class: "loading" }, "Loading …"));
  const [build, argument, title] = pageOf(path || "/");
  document.title = `${title} · fnsf`;
  try {
    await build(page, closing.signal, argument);
  } catch (error) {
    if (!closing.signal.aborted) showFailure(page, error);
  }
}

/** The links to the pages. Readers with a share link, and of local files, have one page alone. */
function showHeader(path, isLocal) {
  const isAlone = isShared() || isLocal;
  const nav = document.getElementById("nav");
  const links = PAGES.map(({ address, text }) => {
    const isHere = address === `#${path || "/"}` || (address === "#/jobs" && path.startsWith("/jobs"));
    return el("a", { href: address, "aria-current": isHere ? "page" : null }, text);
  });
  fill(nav, isAlone ? [] : links);
  const keyButton = document.getElementById("key");
  keyButton.hidden = isAlone;
  keyButton.textContent = key() ? "Key ✓" : "Key";
}

function showFailure(page, error) {
  const isRefusal = error instanceof Refusal;
  if (!isRefusal) console.error(error);
  const words = isRefusal ? error.message : `the page broke: ${error.message}`;
  fill(page, el("div", { class: "failure", role: "alert", data: { test: "failure" } }, words));
  // A reader with a share link has no key: the link is void.
  if (error.code === "unauthenticated" && !isShared()) askForKey(key() ? "The server does not know this key." : null);
}

/** Asks for the key in a dialog. `complaint` says why. */
function askForKey(complaint) {
  if (document.querySelector("dialog[open]")) return;
  const input = el("input", {
    type: "password",
    autocomplete: "off",
    spellcheck: "false",
    // No header carries another one.
    pattern: "[ -~]*",
    title: "printable ASCII characters",
    data: { test: "key-input" },
  });
  input.value = key();
  const close = (value) => {
    if (value !== null) setKey(value);
    dialog.close();
    if (value !== null) void show();
  };
  const form = el(
    "form",
    { method: "dialog", on: { submit: () => close(input.value.trim()) } },
    el("h2", {}, "API key"),
    complaint ? el("p", { class: "failure", role: "alert" }, complaint) : null,
    field("Key", input, "It is kept for this tab alone, and sent to this server alone."),
    el(
      "div",
      { class: "actions" },
      el("button", { type: "submit", class: "primary", data: { test: "key-save" } }, "Use it"),
      button("Forget it", () => close("")),
      button("Cancel", () => close(null)),
    ),
  );
  const dialog = el("dialog", { "aria-label": "API key", on: { close: () => dialog.remove() } }, form);
  document.body.append(dialog);
  dialog.showModal();
}

/** Changes between light and dark. The choice is kept in the browser. */
function changeTheme() {
  const root = document.documentElement;
  const isDark = root.dataset.theme
    ? root.dataset.theme === "dark"
    : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = isDark ? "light" : "dark";
  localStorage.setItem("fnsf-theme", root.dataset.theme);
}

/** Connects the header and shows the first page. */
async function start() {
  const theme = localStorage.getItem("fnsf-theme");
  if (theme) document.documentElement.dataset.theme = theme;
  document.getElementById("theme").addEventListener("click", changeTheme);
  document.getElementById("key").addEventListener("click", () => askForKey(null));
  // The address names the page that is shown, so the link must not change it.
  document.querySelector(".skip").addEventListener("click", (event) => {
    event.preventDefault();
    document.getElementById("page").focus();
  });
  addEventListener("hashchange", () => {
    void show();
    // Keys and screen readers go on in the new page.
    document.getElementById("page").focus({ preventScroll: true });
  });
  addEventListener("unhandledrejection", (event) => {
    if (event.reason instanceof Refusal) {
      event.preventDefault();
      notice(event.reason.message, "bad");
    }
  });
  await show();
}

void start();
