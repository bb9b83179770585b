/**
 * Calls of the public API. The key is kept for the tab alone and sent as a bearer token.
 */

const STORED = "fnsf-key";

/** The token of a share link, which comes before the key while its page is open. */
let shareToken = null;

/** The key of the tab; an empty string if there is none. */
export function key() {
  return sessionStorage.getItem(STORED) ?? "";
}

/** Stores the key for the tab; an empty string removes it. */
export function setKey(value) {
  if (value) sessionStorage.setItem(STORED, value);
  else sessionStorage.removeItem(STORED);
}

/** Uses the token of a share link, or the key again if it is null. */
export function useShareToken(token) {
  shareToken = token;
}

/** Whether a share link is in use. */
export function isShared() {
  return shareToken !== null;
}

/** The address of a job's page; with a share link, for the same reader. */
export function jobAddress(id) {
  const page = `#/jobs/${id}`;
  return isShared() ? `${page}?token=${encodeURIComponent(shareToken)}` : page;
}

/** A refused or failed request, with the words of the server. */
export class Refusal extends Error {
  /**
   * @param {number} status The HTTP status; 0 if the server was not reached.
   * @param {{code?: string, detail?: string}} problem The body of the response.
   */
  constructor(status, problem) {
    super(problem.detail ?? `the server answered with status ${status}`);
    this.status = status;
    this.code = problem.code ?? "unknown";
  }
}

function headers(accept) {
  const sent = {};
  const secret = shareToken ?? key();
  if (secret) sent.Authorization = `Bearer ${secret}`;
  if (accept) sent.Accept = accept;
  return sent;
}

async function refusal(response) {
  const problem = await response.json().catch(() => ({}));
  return new Refusal(response.status, problem);
}

/**
 * Requests a path of this server.
 *
 * @param {string} path
 * @param {{method?: string, accept?: string, signal?: AbortSignal}} [options]
 * @returns {Promise<Response>} A successful response.
 * @throws {Refusal}
 */
export async function call(path, options = {}) {
  let response;
  try {
    const { method = "GET", accept, signal } = options;
    response = await fetch(path, { method, headers: headers(accept), signal, credentials: "omit" });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refusal(0, { code: "unreachable", detail: "the server cannot be reached" });
  }
  if (!response.ok) throw await refusal(response);
  return response;
}

/** The body of a path, read by a method of `Response`. */
async function body(path, options, read) {
  const response = await call(path, options);
  try {
    return await response[read]();
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refusal(0, { code: "unreachable", detail: "the answer was interrupted" });
  }
}

/** The JSON body of a path. */
export function json(path, options = {}) {
  return body(path, options, "json");
}

/** The bytes of a path. */
export function buffer(path, accept) {
  return body(path, { accept }, "arrayBuffer");
}

/**
 * Posts a form and reports the share of it that was sent, 0 to 1.
 *
 * @returns {Promise<Object>} The JSON body of the response.
 * @throws {Refusal}
 */
export function upload(path, form, onSent) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("POST", path);
    for (const [name, value] of Object.entries(headers())) request.setRequestHeader(name, value);
    request.responseType = "json";
    request.upload.addEventListener("progress", (event) => onSent(event.loaded / event.total));
    request.addEventListener("load", () => {
      const body = request.response ?? {};
      if (request.status < 300) resolve(body);
      else reject(new Refusal(request.status, body));
    });
    const lost = () => reject(new Refusal(0, { code: "unreachable", detail: "the upload was interrupted" }));
    request.addEventListener("error", lost);
    request.addEventListener("abort", lost);
    request.send(form);
  });
}

/**
 * Reads the server-sent events of a path until it ends. `fetch` is used because an `EventSource`
 * cannot send a key.
 *
 * @param {string} path
 * @param {AbortSignal} signal Ends the reading.
 * @param {(event: string, data: Object) => void} onEvent
 */
export async function events(path, signal, onEvent) {
  const response = await call(path, { accept: "text/event-stream", signal });
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) deliver(block, onEvent);
  }
}

function deliver(block, onEvent) {
  let [name, data] = ["message", ""];
  for (const line of block.split("\n")) {
    if (line.startsWith("event:")) name = line.slice(6).trim();
    if (line.startsWith("data:")) data += line.slice(5).trim();
  }
  if (data) onEvent(name, JSON.parse(data));
}

/** Saves the result of a path as a file. */
export async function download(path, accept, name) {
  saveAs(await body(path, { accept }, "blob"), name);
}

/** Offers a blob as a file. */
export function saveAs(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
