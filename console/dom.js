/**
 * Elements from script. Texts are set as text nodes, so names from files and labels stay text.
 */

/**
 * Creates an element.
 *
 * @param {string} tag Its name.
 * @param {Object} [properties] `class`, `data` (data attributes), `on` (listeners by event); functions
 *   and booleans are set as properties, everything else as attributes. Null and undefined are left
 *   out.
 * @param {...(Node|string|number|null|Array)} children Nodes and texts.
 * @returns {HTMLElement}
 */
export function el(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined) continue;
    if (name === "class") element.className = value;
    else if (name === "data") Object.assign(element.dataset, value);
    else if (name === "on") {
      for (const [event, listener] of Object.entries(value)) element[`on${event}`] = listener;
    } else if (typeof value === "boolean") element[name] = value;
    else element.setAttribute(name, value);
  }
  append(element, children);
  return element;
}

function append(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child === null || child === undefined) continue;
    element.append(child instanceof Node ? child : document.createTextNode(String(child)));
  }
}

/** Replaces the children of an element. */
export function fill(element, ...children) {
  element.replaceChildren();
  append(element, children);
}

/** The listeners that `update` replaces. */
const LISTENERS = ["onclick", "onchange", "oninput"];

/**
 * Makes the children of an element those that are given, and keeps the elements that are there
 * already. The focus, the scroll position and open menus stay where the order of these elements does.
 * Elements with the same name and the same `id` or `test` among their data are the same.
 */
export function update(element, ...children) {
  const wanted = document.createDocumentFragment();
  append(wanted, children);
  updateChildren(element, wanted);
}

function updateChildren(element, wanted) {
  const there = Map.groupBy(element.childNodes, identityOf);
  const kept = [...wanted.childNodes].map((child) => [there.get(identityOf(child))?.shift() ?? null, child]);
  for (const gone of [...there.values()].flat()) gone.remove();
  let next = element.firstChild;
  for (const [old, child] of kept) {
    if (old) updateNode(old, child);
    if (old && old === next) next = next.nextSibling;
    else element.insertBefore(old ?? child, next);
  }
}

function identityOf(node) {
  return `${node.nodeName} ${node.dataset?.id ?? node.dataset?.test ?? ""}`;
}

function updateNode(old, wanted) {
  if (!(old instanceof Element)) {
    if (old.data !== wanted.data) old.data = wanted.data;
    return;
  }
  for (const { name } of [...old.attributes]) {
    // Whether a menu is open is up to the reader.
    if (!wanted.hasAttribute(name) && name !== "open") old.removeAttribute(name);
  }
  for (const { name, value } of wanted.attributes) {
    if (old.getAttribute(name) === value) continue;
    // The page's policy forbids styles as attributes.
    if (name === "style") old.style.cssText = value;
    else old.setAttribute(name, value);
  }
  for (const listener of LISTENERS) old[listener] = wanted[listener];
  updateChildren(old, wanted);
}

/** A button. `data` holds data attributes, such as `test`. */
export function button(text, onClick, properties = {}) {
  return el("button", { type: "button", ...properties, on: { click: onClick } }, text);
}

/** A label with its control. `hint` is a text below it that describes the control. */
export function field(text, control, hint = null) {
  const id = control.id || `field-${(field.count = (field.count ?? 0) + 1)}`;
  control.id = id;
  const parts = [el("label", { for: id }, text), control];
  if (hint) {
    const described = `${id}-hint`;
    control.setAttribute("aria-describedby", described);
    parts.push(el("p", { class: "hint", id: described }, hint));
  }
  return el("div", { class: "field" }, parts);
}

/** A select with `[value, text]` options. */
export function select(options, value, onChange, properties = {}) {
  const control = el(
    "select",
    { ...properties, on: { change: () => onChange(control.value) } },
    options.map(([option, text]) => el("option", { value: option }, text)),
  );
  control.value = value;
  return control;
}

/** A bar that shows `share`, 0 to 1. `name` says of what. */
export function progressBar(name) {
  return el("progress", { max: "1", value: "0", "aria-label": name });
}

/** Shows a text, or nodes, at the edge of the page for some seconds. */
export function notice(content, kind = "info") {
  const shown = el("div", { class: `notice ${kind}` }, content);
  document.getElementById("notices").append(shown);
  setTimeout(() => shown.remove(), 8000);
}
