// Touching the document only where something changed, so that painting stays cheap.

/** @param {string} id @returns {any} the element; throws where there is none */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found;
}

/** @type {WeakMap<Element, string>} */
const shown = new WeakMap();

/** Write a text, if it is another one than before. @param {Element} element @param {string} text */
export function setText(element, text) {
  if (shown.get(element) === text) return;
  shown.set(element, text);
  element.textContent = text;
}

/** @param {HTMLElement} element @param {boolean} visible */
export function show(element, visible) {
  if (element.hidden === visible) element.hidden = !visible;
}

/**
 * Set a data attribute, or remove it with null.
 * @param {HTMLElement} element @param {string} name @param {string | null} value
 */
export function setData(element, name, value) {
  if ((element.dataset[name] ?? null) === value) return;
  if (value === null) delete element.dataset[name];
  else element.dataset[name] = value;
}

/** @param {Element} element @param {string} name @param {string} value */
export function setAttribute(element, name, value) {
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

/** A new element. @param {string} tag @param {string} [className] @param {string} [text] @returns {any} */
export function make(tag, className = "", text = "") {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text) made.textContent = text;
  return made;
}

/**
 * A row of small buttons of which one is chosen.
 * @param {HTMLElement} place @param {string[]} names @param {(name: string) => void} choose
 */
export function segments(place, names, choose) {
  place.replaceChildren(...names.map((name) => {
    const button = make("button", "", name);
    button.type = "button";
    button.addEventListener("click", () => choose(name));
    return button;
  }));
  place.hidden = names.length < 2;
}

/** Mark the chosen one. @param {HTMLElement} place @param {string} name */
export function choose(place, name) {
  for (const button of place.children) setAttribute(button, "aria-pressed", String(button.textContent === name));
}
