/**
 * Elements from script. Texts become text nodes, so that names of files stay text.
 */

/**
 * Creates an element.
 *
 * @param {string} tag
 * @param {Object} [options] `class`, `test` (data-test), `on` (listeners by event), and attributes;
 *   true sets an empty attribute, false and null none.
 * @param {...(Node|string)} children
 * @returns {HTMLElement}
 */
export function make(tag, { class: names, test, on = {}, ...attributes } = {}, ...children) {
  const element = document.createElement(tag);
  if (names) element.className = names;
  if (test) element.dataset.test = test;
  for (const [event, listener] of Object.entries(on)) element.addEventListener(event, listener);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) element.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) element.setAttribute(name, value);
  }
  element.append(...children);
  return element;
}

/** A button with a text, or with a sign and `aria-label`. */
export function makeButton(text, press, options = {}) {
  return make("button", { type: "button", class: "fv-button", ...options, on: { click: press } }, text);
}

/** A check box within its label. The box is the label's `control`. */
export function makeCheck(text, change, { title, test }) {
  const box = make("input", { type: "checkbox", test, on: { change: () => change(box.checked) } });
  return make("label", { class: "fv-check", title }, box, make("span", {}, text));
}

/** A slider. `change` gets its number. */
export function makeRange(change, options) {
  const range = make("input", {
    type: "range",
    class: "fv-range",
    ...options,
    on: { input: () => change(Number(range.value)) },
  });
  return range;
}

/** A list to choose from. `change` gets the value. */
export function makeSelect(choices, change, options) {
  const items = choices.map(([value, text]) => make("option", { value }, text));
  const select = make(
    "select",
    { class: "fv-select", ...options, on: { change: () => change(select.value) } },
    ...items,
  );
  return select;
}

/** Sets a text where it has changed, so that nothing is laid out again without need. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Enables a control, or disables it and says why. */
export function setEnabled(control, isEnabled, title, why) {
  control.disabled = !isEnabled;
  const holder = control.closest("label") ?? control;
  holder.title = isEnabled ? title : why;
  holder.classList.toggle("fv-off", !isEnabled);
}
