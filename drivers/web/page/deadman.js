// The page's side of the dead-man: its sign of life 50 times a second, and the cases in which it releases everything.

import { PAD_SILENCE } from "./keys.js";

const PERIOD = 20; // ms
const SOONEST = 6; // ms between two messages for what moves: shorter than the time between two pictures at 120 Hz
const CLOGGED = 4096; // bytes that wait in the browser; what this turn of its loop has sent always does
const STALL = 1000 * PAD_SILENCE; // ms; a page that hangs for longer loses its pad

/**
 * Sends the whole pad regularly, and at once when it changes.
 *
 * Runs on the main thread on purpose: a page that hangs must look like a pad that is gone. Every message proves when the
 * page was alive: it has the newest `t` that the program sent, and how long ago that came.
 */
export class Heartbeat {
  /**
   * @param {import("./pad.js").Pad} pad
   * @param {import("./connection.js").Connection} connection
   * @param {() => boolean} mayDrive whether this page is in control and has the focus
   */
  constructor(pad, connection, mayDrive) {
    this.pad = pad;
    this.connection = connection;
    this.mayDrive = mayDrive;
    this.beats = 0;
    /**
     * Called before every message: reads what sends no events (gamepads, keys that move the gripper).
     * @type {((dt: number) => void)[]}
     */
    this.before = [];
    /** Called with the length of a stall of this page, ms. @type {(ms: number) => void} */
    this.stalled = () => {};
    /** Called with the length of a round trip that is too long, ms. @type {(ms: number) => void} */
    this.slow = () => {};
    /** Time of the newest round trip, in ms. @type {number | null} */
    this.roundTrip = null;
    pad.changed.push((edge) => this.#changed(edge));
  }

  #seen = 0;
  #seenAt = 0;
  #movedAt = -Infinity; // time of the newest message for a change; a beat in between delays none
  #lastBeat = 0;
  #clogged = false;
  #running = false;
  #probe = /** @type {number | null} */ (null);

  start() {
    setInterval(() => this.#beat(), PERIOD);
  }

  /** Start after control was granted at `t`, s on the app's clock. @param {number} t */
  granted(t) {
    this.#see(t);
    this.#probe = null;
    this.#running = false;
    this.#beat();
  }

  /** Note an answer of the program, sent at `t`. @param {number} t */
  answered(t) {
    this.beats += 1;
    this.#see(t);
    if (this.#probe !== null) {
      this.roundTrip = performance.now() - this.#probe;
      if (this.roundTrip > STALL) this.slow(this.roundTrip);
    }
    this.#probe = null;
  }

  /** Send a message if one is due: a headset may slow down the timers of its browser, but not its pictures. */
  pump() {
    if (performance.now() - this.#lastBeat >= PERIOD) this.#beat();
  }

  /** Report the pad as gone. @param {Why | "hands"} why */
  leave(why) {
    this.#running = false;
    this.connection.send({ type: "away", why });
  }

  /** @param {number} t */
  #see(t) {
    this.#seen = t;
    this.#seenAt = performance.now();
  }

  #beat() {
    const now = performance.now();
    if (!this.mayDrive()) {
      this.#running = false;
      return;
    }
    const gap = now - this.#lastBeat;
    if (this.#running && gap > STALL) this.stalled(gap);
    const dt = this.#running ? Math.min(gap, 2 * PERIOD) / 1000 : 0;
    this.#running = true;
    this.#lastBeat = now;
    for (const read of this.before) read(dt);
    const full = this.connection.buffered > CLOGGED;
    if (!(full && this.#clogged)) this.#send(now); // what waits to be sent grows old: let it drain
    this.#clogged = full;
  }

  /** @param {boolean} edge */
  #changed(edge) {
    const now = performance.now();
    if (!this.#running || !this.mayDrive() || this.#clogged) return;
    if (edge || now - this.#movedAt >= SOONEST) this.#send((this.#movedAt = now));
  }

  /** @param {number} now */
  #send(now) {
    if (this.#probe === null || now - this.#probe > 1000) this.#probe = now;
    const axes = this.pad.axes.map((value) => Math.round(value * 1e4) / 1e4);
    const since = performance.now() - this.#seenAt;
    const { mask, hands } = this.pad;
    this.connection.send({ type: "pad", seen: this.#seen, since, axes, buttons: mask, hands });
  }
}

/** @typedef {"hidden" | "blur" | "closing" | "headset"} Why */

/** Whether the page is visible and has the focus, or is shown by a headset: only then may it drive. */
export class Presence {
  constructor() {
    /** The headset's session, while there is one. @type {any} */
    this.session = null;
    this.present = this.#isInFront();
    /** @type {(why: Why) => void} */
    this.left = () => {};
    this.came = () => {};
    addEventListener("blur", () => this.session || this.#leave("blur"));
    addEventListener("pagehide", () => this.#leave("closing"));
    for (const type of ["focus", "pageshow"]) addEventListener(type, () => this.#update());
    document.addEventListener("freeze", () => this.#leave("hidden"));
    document.addEventListener("visibilitychange", () => this.#update());
  }

  /** Check again, in case an event was lost. @returns {boolean} */
  check() {
    this.#update();
    return this.present;
  }

  #isInFront() {
    if (this.session) return this.session.visibilityState === "visible";
    return document.visibilityState === "visible" && document.hasFocus();
  }

  #update() {
    if (!this.#isInFront()) this.#leave(this.session ? "headset" : document.visibilityState === "visible" ? "blur" : "hidden");
    else if (!this.present) {
      this.present = true;
      this.came();
    }
  }

  /** @param {Why} why */
  #leave(why) {
    if (!this.present) return;
    this.present = false;
    this.left(why);
  }
}

/** A menu and a drag keep keys and buttons for themselves; the page gets no event when one is released. */
const TAKES_INPUT = ["contextmenu", "dragstart"];

/** Detects releases that the page may have missed: of keys and of everything else that is held. */
export class ReleaseWatch {
  /** @param {import("./pad.js").Pad} pad @param {import("./keyboard.js").Keyboard} keyboard */
  constructor(pad, keyboard) {
    this.pad = pad;
    this.keyboard = keyboard;
    this.repeats = new KeyRepeats();
    this.echo = new BrowserEcho();
    /** Called when what is held may have been released long ago. @type {(why: string) => void} */
    this.lost = () => {};
    for (const type of TAKES_INPUT) addEventListener(type, (event) => event.preventDefault(), true);
    addEventListener("pointerdown", (event) => this.#menu(event), true);
  }

  /** Check, before every message. @param {number} dt time since the last call, s */
  check(dt) {
    const ceased = this.repeats.ceased(dt) && this.keyboard.holds;
    const overdue = this.echo.overdue(dt) && this.pad.held;
    if (ceased) this.lost("this window lost the keyboard: all controls released");
    else if (overdue) this.lost("the browser hung: all controls released");
  }

  /** Release everything: with Shift, Firefox opens its menu in any case. @param {PointerEvent} event */
  #menu(event) {
    if (event.pointerType === "mouse" && event.button === 2 && event.shiftKey) this.pad.reset();
  }
}

const SURE = 2; // repetitions after which a key counts as one that repeats
const CEASED = 0.3; // s without a repetition after which it has ceased, at least
const PERIODS = 4; // and at least so many of this keyboard's own periods: a slow one takes seconds

/**
 * Watches the repetition of a held key: if it ceases without a release, another program has the keyboard (a locked
 * screen or a screenshot tool, for example), which no event reports.
 *
 * Only the newest key repeats, and not on every keyboard: the watch begins when repetitions were seen, and ends with
 * everything that may end them, until they are seen again.
 */
class KeyRepeats {
  constructor() {
    addEventListener("keydown", (event) => this.#pressed(event), true);
    for (const type of ["keyup", "pointerdown", "blur"]) addEventListener(type, () => this.#forget(), true);
  }

  #key = "";
  #count = 0;
  #at = 0;
  #longest = 0; // s between two repetitions
  #silent = 0;

  /**
   * Count time, only what this page was awake for: after a short hang, events that still wait are not missing.
   * @param {number} dt s @returns {boolean} whether the newest key has ceased; true once
   */
  ceased(dt) {
    if (this.#count < SURE) return false;
    this.#silent += dt;
    if (this.#silent <= Math.max(CEASED, PERIODS * this.#longest)) return false;
    this.#forget();
    return true;
  }

  /** @param {KeyboardEvent} event */
  #pressed(event) {
    if (!event.repeat || event.code !== this.#key) {
      this.#forget();
      this.#key = event.code;
      return;
    }
    const now = event.timeStamp / 1000;
    if (this.#count) this.#longest = Math.max(this.#longest, now - this.#at); // before the first one there is a delay
    this.#count += 1;
    this.#at = now;
    this.#silent = 0;
  }

  #forget() {
    this.#count = this.#longest = this.#silent = 0;
  }
}

const OVERDUE = 0.17; // s without an answer

/**
 * Checks that the browser's main process, which passes on keys and touches, still runs: it may hang while this page, a
 * process of its own, does not. Sends messages to itself through that process.
 *
 * In a browser without such a way, no message is ever overdue.
 */
class BrowserEcho {
  constructor() {
    const name = `hal-console-${performance.timeOrigin}-${Math.random()}`; // other pages have channels of their own
    try {
      this.#sender = new BroadcastChannel(name);
      this.#receiver = new BroadcastChannel(name);
      this.#receiver.onmessage = () => this.#heard();
    } catch {
      this.#sender = null; // an old browser, or one that forbids it
    }
  }

  /** @type {BroadcastChannel | null} */ #sender;
  /** @type {BroadcastChannel | undefined} */ #receiver;
  #works = false;
  #silent = 0;

  /**
   * Send once more. Time counts as in KeyRepeats: answers that wait while this page hangs are not missing.
   * @param {number} dt s since the last call; 0: after a pause @returns {boolean} whether an answer is overdue
   */
  overdue(dt) {
    this.#silent = dt ? this.#silent + dt : 0;
    this.#sender?.postMessage(0);
    return this.#works && this.#silent > OVERDUE;
  }

  #heard() {
    this.#works = true;
    this.#silent = 0;
  }
}
