// One pad out of everything that may drive at the same time: fingers on the page, keys, a gamepad.
//
// The server makes keys.js: AXES and BUTTONS are those of hal/types.py, in the order in which they are sent. Sticks,
// d-pad and joints are -1..1 (right and up positive), those of ONE_SIDED are 0..1; bit k of a mask is button k.

import { AXES, BUTTONS, ONE_SIDED } from "./keys.js";

/** Name of an axis -> its place. */
export const AXIS = Object.fromEntries(AXES.map((name, place) => [name, place]));

/** Name of a button -> its bit, as a number with only that bit set. */
export const BIT = Object.fromEntries(BUTTONS.map((name, place) => [name, 1 << place]));

/** Name of a disc -> its two axes, across and up. */
export const DISCS = { dpad: ["dpad_x", "dpad_y"], left: ["left_x", "left_y"], right: ["right_x", "right_y"] };

const SHORTEST = 80; // ms; an app reads the pad 50 times a second, and a tap on a trackpad may be shorter

/** Prolongs short presses of buttons that move nothing, so that the app sees them. */
class Taps {
  /** @param {() => void} ended called when a prolonged press is over */
  constructor(ended) {
    this.ended = ended;
  }

  #pressed = 0;
  /** Bit of a button that was pressed a moment ago -> the timer that ends that. @type {Map<number, number>} */
  #young = new Map();

  /**
   * @param {number} pressed mask of the buttons that are down
   * @param {number} may mask of those that may be prolonged; one that no longer may is released at once
   * @returns {number} mask of the buttons that count as pressed
   */
  prolong(pressed, may) {
    const fresh = pressed & ~this.#pressed & may;
    this.#pressed = pressed;
    for (const bit of this.#young.keys()) if (!(bit & may)) this.#end(bit);
    for (let rest = fresh; rest; rest &= rest - 1) this.#start(rest & -rest);
    return [...this.#young.keys()].reduce((mask, bit) => mask | bit, pressed);
  }

  /** Release everything that is prolonged. */
  forget() {
    for (const bit of this.#young.keys()) this.#end(bit);
  }

  /** @param {number} bit */
  #start(bit) {
    this.#end(bit);
    this.#young.set(bit, setTimeout(() => {
      this.#young.delete(bit);
      this.ended();
    }, SHORTEST));
  }

  /** @param {number} bit */
  #end(bit) {
    clearTimeout(this.#young.get(bit));
    this.#young.delete(bit);
  }
}

const TRIGGERS = ONE_SIDED.map((name) => AXIS[name]);
const PRESSED = 0.5;

/** What one input device pushes and presses at the moment. */
export class Source {
  constructor() {
    this.axes = AXES.map(() => 0);
    this.mask = 0;
    /** Whether its dead-man counts by itself. */
    this.mayHold = true;
  }

  clear() {
    this.axes.fill(0);
    this.mask = 0;
  }
}

/**
 * The merged pad: sticks add up, of triggers the farthest counts, a button is pressed when any source presses it.
 *
 * Home counts only while the dead-man is held, and is released with it. A press that moves nothing may be prolonged; one
 * of the dead-man, or of anything that moves the arm, never is.
 */
export class Pad {
  constructor() {
    this.axes = AXES.map(() => 0);
    this.mask = 0;
    /** Whether the dead-man is pressed here; whether the servo received that is in its state. */
    this.held = false;
    /** Position of the gripper's slider, 0 open .. 1 closed; it stays where it is. */
    this.grip = 0;
    /** Side of a hand that holds -> its pose and grip. "any" holds the dead-man of this pad, another side its own. */
    this.hands = /** @type {Record<string, number[]>} */ ({});
    this.deadman = "l2";
    /** @type {string | null} */
    this.home = null;
    /** @type {Source[]} */
    this.sources = [];
    /** Called after every change; `edge`: something was pressed or released. @type {((edge: boolean) => void)[]} */
    this.changed = [];
    /** Called by reset() to forget whatever is held. @type {(() => void)[]} */
    this.released = [];
  }

  #holding = /** @type {Set<string>} */ (new Set());
  #homing = /** @type {Set<string>} */ (new Set());
  #taps = new Taps(() => this.update());
  /** Mask of the buttons that move nothing, and of those that do. */
  #moveless = 0;
  #shown = /** @type {Record<string, number[]>} */ ({});
  #moving = 0;

  /** Whether something is pushed that may move the arm. The gripper's slider does not count: it stays where it is. */
  get pushed() {
    const sticks = this.axes.some((value, place) => value !== 0 && !TRIGGERS.includes(place));
    return sticks || (this.mask & this.#moving) !== 0;
  }

  /** Return a further source. */
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
   * Set which controls are the dead-man and the way home, which buttons move nothing, and which controls move the arm.
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

  /** Release everything, the gripper's slider included. */
  reset() {
    this.#holding.clear();
    this.#homing.clear();
    this.#taps.forget();
    this.grip = 0;
    for (const source of this.sources) source.clear();
    for (const forget of this.released) forget();
    this.update();
  }

  /** Merge the sources again; calls `changed` if the result differs. */
  update() {
    const axes = AXES.map(() => 0);
    let mask = 0;
    for (const source of this.sources) mask |= this.#add(axes, source);
    if (this.deadman !== "r2") axes[AXIS.r2] = Math.max(axes[AXIS.r2], this.grip);
    if (this.#holding.size || this.hands.any) {
      if (this.deadman in AXIS) axes[AXIS[this.deadman]] = 1;
      mask |= BIT[this.deadman];
    }
    for (const trigger of TRIGGERS) if (axes[trigger] > PRESSED) mask |= BIT[AXES[trigger]];
    const held = (mask & BIT[this.deadman]) !== 0;
    if (!held) this.#homing.clear();
    if (this.home && this.#homing.size) mask |= BIT[this.home];
    this.#take(axes, this.#taps.prolong(mask, this.#prolonged(held)), held);
  }

  /**
   * Return the mask of the buttons of which a short press is prolonged: also the way home, but not beyond the dead-man.
   * @param {boolean} held
   */
  #prolonged(held) {
    const home = this.home ? BIT[this.home] : 0;
    return held ? this.#moveless | home : this.#moveless & ~home;
  }

  /** @param {number[]} axes @param {Source} source @returns {number} mask of its buttons that count */
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
    const [sides, before] = [this.hands, this.#shown].map((hands) => Object.keys(hands).join());
    const pressed = mask !== this.mask || sides !== before;
    const edge = pressed || axes.some((value, place) => (value === 0) !== (this.axes[place] === 0));
    const same = !edge && (!sides || this.hands === this.#shown);
    if (same && axes.every((value, place) => value === this.axes[place])) return;
    this.#shown = this.hands;
    this.axes = axes;
    this.mask = mask;
    this.held = held;
    for (const tell of this.changed) tell(edge);
  }
}
