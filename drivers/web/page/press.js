// A press of a finger or a mouse on a control, until it ends in whichever way.

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
