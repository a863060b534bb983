// A press of a finger or a mouse: on a control, until it ends in whichever way; or on a button that asks for something.

/**
 * @typedef {object} Handlers
 * @property {(event: PointerEvent) => boolean | void} down `false`: this press does not count
 * @property {(event: PointerEvent) => void} [move]
 * @property {() => void} up the last finger has left, was taken away, or is forgotten
 */

const LEFT = 1; // of PointerEvent.buttons

/**
 * Follow the presses on an element. A control that drives holds on to the pointer, so that sliding off it neither
 * lets go nor presses its neighbour; a pointer that is cancelled or lost is let go of. So is a mouse that has another
 * button down as well: the last of its buttons alone is told of when it is let go of, and the press may be over by then.
 *
 * @param {HTMLElement} element
 * @param {Handlers} handlers
 * @returns {() => void} forget all presses: they count again only after a new one
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
  const noMagnifier = (/** @type {TouchEvent} */ event) => event.cancelable && event.preventDefault();
  element.addEventListener("touchstart", noMagnifier, { passive: false });

  return () => {
    if (!pointers.size) return;
    pointers.clear();
    up();
  };
}

/**
 * Do something when a press ends on the element; who slides off it has thought better of it. Unlike a click this works
 * with a second finger, while the first one holds the dead-man. Needs `touch-action: none`.
 *
 * @param {HTMLElement} element @param {() => void} act
 */
export function onTap(element, act) {
  let pointer = NaN;
  element.addEventListener("pointerdown", (event) => {
    if (event.pointerType === "mouse" && event.button !== 0) return;
    pointer = event.pointerId;
    element.setPointerCapture(pointer); // or it may end elsewhere unheard
  });
  element.addEventListener("pointerup", (event) => {
    if (event.pointerId !== pointer) return;
    pointer = NaN;
    const { left, right, top, bottom } = element.getBoundingClientRect();
    const { clientX: x, clientY: y } = event;
    if (left <= x && x <= right && top <= y && y <= bottom) act();
  });
  element.addEventListener("pointercancel", () => (pointer = NaN));
  element.addEventListener("click", (event) => event.detail === 0 && act()); // from the keyboard or an aid
}
