// The keyboard as a source of the pad.
//
// The server makes keys.js: KEYS is sensors/keyboard.yaml, the one table of keys, which the terminal uses too.

import { KEYS } from "./keys.js";
import { AXIS, BIT } from "./pad.js";

const USED = new Set([
  ...KEYS.hold, ...KEYS.go_home, ...KEYS.slow,
  ...[KEYS.sticks, KEYS.buttons, KEYS.grip].flatMap((keys) => Object.keys(keys)),
]);

/** Whether the key belongs to a field for text. @param {EventTarget | null} target */
function isTyping(target) {
  return target instanceof Element && target.closest("input, textarea, select, [contenteditable]") !== null;
}

/** Whether the key is Enter on an element that was reached with Tab. @param {KeyboardEvent} event */
function isActivation(event) {
  const active = document.activeElement;
  return event.key === "Enter" && active !== null && active.matches("button, summary, a");
}

export class Keyboard {
  /**
   * @param {import("./pad.js").Pad} pad
   * @param {() => boolean} enabled whether this page drives
   * @param {() => void} stop
   */
  constructor(pad, enabled, stop) {
    this.pad = pad;
    this.enabled = enabled;
    this.stop = stop;
    this.source = pad.source();
    pad.released.push(() => this.#down.clear());
    addEventListener("keydown", (event) => this.#pressed(event));
    addEventListener("keyup", (event) => this.#released(event));
  }

  /** Keys that were pressed while this page drove -> the joint's button that Enter presses. @type {Map<string, any>} */
  #down = new Map();
  /** Keys whose press was used here, so that their repetition scrolls nothing. @type {Set<string>} */
  #ours = new Set();

  /** Whether a key of the pad is down. */
  get holds() {
    return this.#down.size > 0;
  }

  /** Move the gripper's slider while its keys are held. @param {number} dt time since the last call, s */
  moveGrip(dt) {
    let way = 0;
    for (const [key, sign] of Object.entries(KEYS.grip)) if (this.#down.has(key)) way += sign;
    if (way) this.pad.setGrip(this.pad.grip + way * KEYS.grip_speed * dt);
  }

  /** @param {KeyboardEvent} event */
  #pressed(event) {
    const key = event.code;
    if (event.repeat && isActivation(event)) event.preventDefault(); // one press is one click
    const stop = KEYS.stop.includes(key) || (KEYS.hold.includes(key) && document.activeElement?.id === "stop");
    if (stop) return this.#stopped(event);
    if (event.key === "Meta") return this.#releaseAll(); // the system swallows the releases of other keys
    if (!USED.has(key) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.repeat) {
      if (this.#ours.has(key)) event.preventDefault();
      return;
    }
    const jog = event.key === "Enter" ? (document.activeElement?.closest("[data-jog]") ?? null) : null;
    if (!this.enabled() || isTyping(event.target) || (!jog && isActivation(event))) return;
    event.preventDefault();
    this.#ours.add(key);
    this.#down.set(key, jog);
    this.#apply();
  }

  /** Esc or Backspace, or Space on the button that was reached with Tab. @param {KeyboardEvent} event */
  #stopped(event) {
    if (KEYS.hold.includes(event.code)) {
      event.preventDefault();
      this.#ours.add(event.code);
    }
    if (!event.repeat) this.stop();
  }

  /** @param {KeyboardEvent} event */
  #released(event) {
    if (this.#ours.delete(event.code)) event.preventDefault(); // or Space would click the focused button
    if (this.#down.delete(event.code)) this.#apply();
  }

  #releaseAll() {
    this.#down.clear();
    this.#apply();
  }

  #apply() {
    const isDown = (/** @type {string} */ key) => this.#down.has(key);
    const reach = KEYS.slow.some(isDown) ? KEYS.slow_share : 1;
    this.source.clear();
    for (const [key, [axis, way]] of Object.entries(KEYS.sticks)) {
      if (this.#down.has(key)) this.source.axes[AXIS[axis]] += way * reach;
    }
    for (const [key, button] of Object.entries(KEYS.buttons)) {
      if (this.#down.get(key) === null) this.source.mask |= BIT[button];
    }
    for (const button of this.#down.values()) {
      if (button) this.source.axes[AXIS[button.dataset.jog]] = reach * button.dataset.way;
    }
    this.pad.hold("key", KEYS.hold.some(isDown));
    this.pad.goHome("key", KEYS.go_home.some(isDown));
  }
}
