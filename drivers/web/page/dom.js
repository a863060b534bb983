// Helpers for the document: elements, presses of fingers and mouse, light or dark theme.

/** @param {string} id @returns {any} the element; throws where there is none */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no #${id}`);
  return found;
}

/** @type {WeakMap<Element, string>} */
const shown = new WeakMap();

/** Set a text, if it differs from the present one; painting stays cheap. @param {Element} element @param {string} text */
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
 * Fill an element with a row of small buttons of which one is chosen.
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

/** Mark the chosen button of such a row. @param {HTMLElement} place @param {string} name */
export function choose(place, name) {
  for (const button of place.children) setAttribute(button, "aria-pressed", String(button.textContent === name));
}

/**
 * @typedef {object} Handlers
 * @property {(event: PointerEvent) => boolean | void} down returns `false` if this press does not count
 * @property {(event: PointerEvent) => void} [move]
 * @property {() => void} up the last finger was lifted, cancelled, or is forgotten
 */

const LEFT = 1; // of PointerEvent.buttons

/**
 * Follow the presses on an element until each ends, in whichever way.
 *
 * A control that drives captures the pointer, so that sliding off it neither releases it nor presses its neighbour. A
 * pointer that is cancelled or lost counts as released. So does a mouse with a second button down: browsers report only
 * the release of the last one, and the press may be over by then.
 *
 * @param {HTMLElement} element
 * @param {Handlers} handlers
 * @returns {() => void} a function that forgets all presses; they count again only after a new one
 */
export function onPress(element, { down, move, up }) {
  /** @type {Set<number>} */
  const pointers = new Set();

  /** @param {number} pointer */
  function end(pointer) {
    if (pointers.delete(pointer) && !pointers.size) up();
  }

  element.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button !== 0) return;
    if (down(event) === false) return;
    pointers.add(event.pointerId);
    element.setPointerCapture(event.pointerId);
  });
  element.addEventListener("pointermove", (event) => {
    if (event.pointerType === "mouse" && event.buttons !== LEFT) end(event.pointerId);
    else if (pointers.has(event.pointerId)) move?.(event);
  });
  for (const type of /** @type {const} */ (["pointerup", "pointercancel", "lostpointercapture"])) {
    element.addEventListener(type, (event) => end(event.pointerId));
  }
  element.addEventListener("touchstart", (/** @type {any} */ event) => { // no magnifier over a control
    if (event.cancelable && event.target.closest(".control")) event.preventDefault();
  }, { passive: false });

  return () => {
    if (!pointers.size) return;
    pointers.clear();
    up();
  };
}

/**
 * Call a function when a press ends on the element; sliding off it cancels. Unlike a click this works with a second
 * finger, while the first one holds the dead-man. Needs `touch-action: none`.
 *
 * @param {HTMLElement} element @param {() => void} act
 */
export function onTap(element, act) {
  let pointer = NaN;
  element.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button !== 0) return;
    pointer = event.pointerId;
    element.setPointerCapture(pointer); // or it may end elsewhere without an event
  });
  element.addEventListener("pointerup", (event) => {
    if (event.pointerId !== pointer) return;
    pointer = NaN;
    const { left, right, top, bottom } = element.getBoundingClientRect();
    const { clientX: x, clientY: y } = event;
    if (left <= x && x <= right && top <= y && y <= bottom) act();
  });
  element.addEventListener("pointercancel", () => (pointer = NaN));
  element.addEventListener("click", (event) => event.detail === 0 && act()); // from the keyboard or an assistive tool
}

const KEY = "hal-console-theme";

/** Return what was chosen on this browser. @param {string} key @returns {string | null} */
export function remembered(key) {
  try {
    return localStorage.getItem(key);
  } catch {
    return null; // a browser may forbid it
  }
}

/** Keep a choice for the next time. @param {string} key @param {string} value */
export function remember(key, value) {
  try {
    localStorage.setItem(key, value);
  } catch {
    // Then it lasts as long as the page is open.
  }
}

/** Follow the system's theme until the button is pressed. @param {() => void} changed called at every change */
export function openTheme(changed) {
  const root = document.documentElement;
  const known = remembered(KEY);
  if (known === "light" || known === "dark") {
    root.dataset.theme = known;
    changed(); // what was drawn before has the other theme's colours
  }
  byId("theme").addEventListener("click", () => {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const now = root.dataset.theme ?? (dark ? "dark" : "light");
    root.dataset.theme = now === "dark" ? "light" : "dark";
    remember(KEY, root.dataset.theme);
    changed();
  });
}
