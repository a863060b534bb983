// One pad out of everything that a person may use at once: fingers on the page, keys, a gamepad.

import { AXES, AXIS, BIT } from "./names.js";
import { Taps } from "./taps.js";

const TRIGGERS = [AXIS.l2, AXIS.r2];
const PRESSED = 0.5;

/** What one way of driving pushes and presses at the moment. */
export class Source {
  constructor() {
    this.axes = AXES.map(() => 0);
    this.mask = 0;
    /** May its dead-man count by itself? */
    this.mayHold = true;
  }

  clear() {
    this.axes.fill(0);
    this.mask = 0;
  }
}

/**
 * Sticks add up, triggers count at their farthest, a button is pressed when any of them presses it.
 *
 * Home counts only while the dead-man is held, and is let go of with it. A press that moves nothing may be prolonged;
 * one of the dead-man, or of anything that moves the arm, never is.
 */
export class Pad {
  constructor() {
    this.axes = AXES.map(() => 0);
    this.mask = 0;
    /** Is the dead-man pressed here? What the servo makes of it stands in its state. */
    this.held = false;
    /** Place of the gripper's slider, 0 open .. 1 closed; it stays where it is. */
    this.grip = 0;
    this.deadman = "l2";
    /** @type {string | null} */
    this.home = null;
    /** @type {Source[]} */
    this.sources = [];
    this.#holding = new Set();
    this.#homing = new Set();
    this.#taps = new Taps(() => this.update());
    /** Called after every change; `edge`: something was pressed or let go of. @type {((edge: boolean) => void)[]} */
    this.changed = [];
    /** Called by reset(): forget whatever is held. @type {(() => void)[]} */
    this.released = [];
  }

  /** @type {Set<string>} */ #holding;
  /** @type {Set<string>} */ #homing;
  /** @type {Taps} */ #taps;
  /** Mask of the buttons that move nothing, and of those that do. */
  #moveless = 0;
  #moving = 0;

  /** Is something pushed that may move the arm? The gripper's slider stays where it is, and does not count. */
  get pushed() {
    const sticks = this.axes.some((value, place) => value !== 0 && !TRIGGERS.includes(place));
    return sticks || (this.mask & this.#moving) !== 0;
  }

  /** A further way of driving. */
  source() {
    const made = new Source();
    this.sources.push(made);
    return made;
  }

  /** Press the dead-man, whichever control that is. @param {string} who @param {boolean} on */
  hold(who, on) {
    if (on) this.#holding.add(who);
    else this.#holding.delete(who);
    this.update();
  }

  /** Press the button that drives home. @param {string} who @param {boolean} on */
  goHome(who, on) {
    if (on) this.#homing.add(who);
    else this.#homing.delete(who);
    this.update();
  }

  /** @param {number} place 0..1 */
  setGrip(place) {
    this.grip = Math.min(1, Math.max(0, place));
    this.update();
  }

  /**
   * What the app calls its dead-man and its way home, which buttons move nothing, and which controls move the arm.
   * @param {string} deadman @param {string | null} home @param {string[]} moveless @param {string[]} moving
   */
  explain(deadman, home, moveless, moving) {
    const other = deadman !== this.deadman;
    this.deadman = deadman;
    this.home = home;
    this.#moveless = moveless.reduce((mask, name) => mask | BIT[name], 0) & ~BIT[deadman];
    this.#moving = moving.reduce((mask, name) => mask | (name in AXIS ? 0 : BIT[name]), 0) & ~BIT[deadman];
    if (other) this.reset();
    else this.update();
  }

  /** Everything neutral and let go of, the gripper's slider included. */
  reset() {
    this.#holding.clear();
    this.#homing.clear();
    this.#taps.forget();
    this.grip = 0;
    for (const source of this.sources) source.clear();
    for (const forget of this.released) forget();
    this.update();
  }

  /** Merge the sources anew; tells whoever listens where that changes something. */
  update() {
    const axes = AXES.map(() => 0);
    let mask = 0;
    for (const source of this.sources) mask |= this.#add(axes, source);
    if (this.deadman !== "r2") axes[AXIS.r2] = Math.max(axes[AXIS.r2], this.grip);
    if (this.#holding.size) {
      if (this.deadman in AXIS) axes[AXIS[this.deadman]] = 1;
      mask |= BIT[this.deadman];
    }
    for (const trigger of TRIGGERS) if (axes[trigger] > PRESSED) mask |= BIT[AXES[trigger]];
    const held = (mask & BIT[this.deadman]) !== 0;
    if (!held) this.#homing.clear();
    if (this.home && this.#homing.size) mask |= BIT[this.home];
    this.#take(axes, this.#taps.look(mask, this.#prolonged(held)), held);
  }

  /**
   * Mask of the buttons of which a short press is prolonged: also of the way home, but never beyond the dead-man.
   * @param {boolean} held
   */
  #prolonged(held) {
    const home = this.home ? BIT[this.home] : 0;
    return held ? this.#moveless | home : this.#moveless & ~home;
  }

  /** @param {number[]} axes @param {Source} source @returns {number} the buttons that count */
  #add(axes, source) {
    const dropped = source.mayHold ? null : this.deadman;
    AXES.forEach((name, place) => {
      if (name === dropped) return;
      const value = source.axes[place];
      if (TRIGGERS.includes(place)) axes[place] = Math.max(axes[place], value);
      else axes[place] = Math.min(1, Math.max(-1, axes[place] + value));
    });
    return dropped === null ? source.mask : source.mask & ~BIT[dropped];
  }

  /** @param {number[]} axes @param {number} mask @param {boolean} held */
  #take(axes, mask, held) {
    const edge = mask !== this.mask || axes.some((value, place) => (value === 0) !== (this.axes[place] === 0));
    if (!edge && axes.every((value, place) => value === this.axes[place])) return;
    this.axes = axes;
    this.mask = mask;
    this.held = held;
    for (const tell of this.changed) tell(edge);
  }
}
