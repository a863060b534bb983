// The keyboard as a pad.

import { AXIS, BIT, SLOWER } from "./names.js";
import { AXIS_KEYS, BUTTON_KEYS, GRIP_KEYS, HOLD_KEY, HOME_KEY, SLOW_KEYS, STOP_KEYS } from "./names.js";

const GRIP_SPEED = 1; // full travels of the slider per second
const USED = new Set([
  HOLD_KEY, HOME_KEY, ...Object.keys(AXIS_KEYS), ...Object.keys(BUTTON_KEYS), ...Object.keys(GRIP_KEYS), ...SLOW_KEYS,
]);

/** @param {EventTarget | null} target */
function isTyping(target) {
  return target instanceof Element && target.closest("input, textarea, select, [contenteditable]") !== null;
}

/** Enter belongs to what was reached with Tab. @param {KeyboardEvent} event */
function isActivation(event) {
  const active = document.activeElement;
  return event.key === "Enter" && active !== null && active.matches("button, summary, a");
}

export class Keyboard {
  /**
   * @param {import("./pad.js").Pad} pad
   * @param {() => boolean} enabled does this page drive?
   * @param {() => void} stop
   */
  constructor(pad, enabled, stop) {
    this.pad = pad;
    this.enabled = enabled;
    this.stop = stop;
    this.source = pad.source();
    pad.released.push(() => this.#down.clear());
    addEventListener("keydown", (event) => this.#pressed(event));
    addEventListener("keyup", (event) => this.#let(event));
  }

  /** Keys that were pressed while this page drove. @type {Set<string>} */
  #down = new Set();
  /** Keys whose press was ours, so that their repetition scrolls nothing. @type {Set<string>} */
  #ours = new Set();

  /** Is a key of the pad down? */
  get holds() {
    return this.#down.size > 0;
  }

  /** Move the gripper's slider by as long as its keys are held. @param {number} dt s */
  look(dt) {
    let way = 0;
    for (const [key, sign] of Object.entries(GRIP_KEYS)) if (this.#down.has(key)) way += sign;
    if (way) this.pad.setGrip(this.pad.grip + way * GRIP_SPEED * dt);
  }

  /** @param {KeyboardEvent} event */
  #pressed(event) {
    const key = event.code;
    if (event.repeat && isActivation(event)) event.preventDefault(); // one press is one click
    const stop = STOP_KEYS.includes(key) || (key === HOLD_KEY && document.activeElement?.id === "stop");
    if (stop) return this.#stopped(event);
    if (event.key === "Meta") return this.#releaseAll(); // its system swallows the releases of other keys
    if (!USED.has(key) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.repeat) {
      if (this.#ours.has(key)) event.preventDefault();
      return;
    }
    if (!this.enabled() || isTyping(event.target) || isActivation(event)) return;
    event.preventDefault();
    this.#ours.add(key);
    this.#down.add(key);
    this.#apply();
  }

  /** Esc or Backspace, or Space on the button that was reached with Tab. @param {KeyboardEvent} event */
  #stopped(event) {
    if (event.code === HOLD_KEY) {
      event.preventDefault();
      this.#ours.add(HOLD_KEY);
    }
    if (!event.repeat) this.stop();
  }

  /** @param {KeyboardEvent} event */
  #let(event) {
    if (this.#ours.delete(event.code)) event.preventDefault(); // or Space would click the button that has the focus
    if (this.#down.delete(event.code)) this.#apply();
  }

  #releaseAll() {
    this.#down.clear();
    this.#apply();
  }

  #apply() {
    const reach = SLOW_KEYS.some((key) => this.#down.has(key)) ? SLOWER : 1;
    this.source.clear();
    for (const [key, [axis, way]] of Object.entries(AXIS_KEYS)) {
      if (this.#down.has(key)) this.source.axes[AXIS[axis]] += way * reach;
    }
    for (const [key, button] of Object.entries(BUTTON_KEYS)) {
      if (this.#down.has(key)) this.source.mask |= BIT[button];
    }
    this.pad.hold("key", this.#down.has(HOLD_KEY));
    this.pad.goHome("key", this.#down.has(HOME_KEY));
  }
}
