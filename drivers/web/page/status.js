// What matters at once: the state of the arm and of the dead-man, stops and faults, the confirmation of STOP, the log.

import { byId, make, setData, setText, show } from "./dom.js";
import { PAD_SILENCE } from "./keys.js";

const OLD = 500; // ms without a state until the page says so
const STOPPING = 1000; // ms within which a state shows the stop after the message that STOP was pressed
const NEAR = 2000; // ms between what was measured and the state that shows the stop for it
const MOVING = 0.005; // rad/s; slower joints are at rest

/** Status of a robot -> label. @type {Record<string, string>} */
const WORDS = { idle: "idle", holding: "stopped", tripped: "stopped" };
/** What limits a motion -> label. @type {Record<string, string>} */
const LIMITS = { speed: "joint speed", "tcp speed": "tool speed", collision: "something near" };

/**
 * What was measured when the pad was lost -> why the arm is stopped, and what to do about it; the first one counts.
 * The table of all states of trouble is in docs/console.md.
 * @type {[string, (seconds: string) => string, string][]}
 */
const CAUSES = [
  ["hang", (seconds) => `this computer is too busy (the page hung for ${seconds} s)`, "Close other programs and tabs."],
  ["late", (seconds) => `the robot's computer is too busy (${seconds} s late)`, "End other programs on it."],
  [
    "slow", (seconds) => `the network is too slow (a round trip took ${seconds} s; at most ${PAD_SILENCE} s)`,
    "Use a cable, or a computer nearer to the robot.",
  ],
];

/** Trip -> text, where a page is the pad. @type {Record<string, string>} */
const PAGE_TRIPS = {
  deadman_silent: "the page in control gave no sign of life",
  deadman_lost: "the page in control was disconnected",
};

const RECOVER = 'Press "Recover", then release everything and hold again.';
const TAKE = 'Press "Take control" to drive.';

/** Return the state of the dead-man in one word. @param {any} deadman of a robot's state */
function deadmanWord(deadman) {
  if (!deadman) return "none";
  if (!deadman.connected) return "no pad";
  if (deadman.age > PAD_SILENCE) return "silent";
  return deadman.held ? "held" : "released";
}

/** Return a text with a capital letter. @param {string} text */
const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}`;

/** @param {any} robot */
function isMoving(robot) {
  return robot.dq?.some((/** @type {number} */ speed) => Math.abs(speed) > MOVING) ?? false;
}

/** The lamps of the header, the banners, and the line beside the button to hold. */
export class Status {
  /** @param {import("./connection.js").Connection} connection @param {import("./control.js").Lease} lease */
  constructor(connection, lease) {
    this.lease = lease;
    this.waiting = /** @type {string[]} */ ([]);
    this.faulty = "";
    this.deadman = "unknown";
    this.status = "unknown";
    this.moving = false;
    this.trip = "none";
    /** Whether this page's pad holds the dead-man. */
    this.held = false;
    this.present = true;
    /** Name of what is held: "Space", "L2" or "the button". */
    this.holdName = () => "Space";
    byId("recover").addEventListener("click", () => connection.send({ type: "recover", robot: this.faulty }));
  }

  #noticeTimer = 0;
  #heldAt = 0; // ms
  /** Why the pad was lost last, and whether that was unintended. */
  #loss = { text: "", alarm: false };
  /** Who pressed STOP last, and when; "" if unknown. */
  #stopped = "";
  #stoppedAt = -Infinity; // ms
  /** What was measured last, and when, ms. @type {Record<string, {length: number, at: number}>} */
  #measured = {};
  #trippedAt = -Infinity; // ms
  /** Time of day at which this page saw the arm stop; "" if it was before. */
  #since = "";
  #known = false;

  /** Note what may cost the pad: one of CAUSES, and how long it took. @param {string} cause @param {number} ms */
  note(cause, ms) {
    this.#measured[cause] = { length: ms, at: performance.now() };
  }

  /** Start anew with another connection: what an arm is stopped for then is older than the page. */
  forget() {
    this.#known = false;
  }

  /** What was measured about this page when it lost the pad, if it was not let go of on purpose. */
  get #cause() {
    if (!this.lease.mine || this.#calm || !(this.trip in PAGE_TRIPS)) return undefined;
    const found = CAUSES.find(([cause]) => Math.abs(this.#measured[cause]?.at - this.#trippedAt) < NEAR);
    return found && { text: found[1]((this.#measured[found[0]].length / 1000).toFixed(1)), remedy: found[2] };
  }

  /** Note a message of the program. @param {any} message @param {Date} at */
  addMessage({ text, loss, stop }, at) {
    if (loss) this.#loss = { text, alarm: loss === "alarm" };
    if (!stop) return;
    this.#stopped = `${stop === this.lease.page ? "you" : stop}, ${at.toTimeString().slice(0, 8)}`;
    this.#stoppedAt = performance.now();
  }

  /**
   * @param {any} robots of a state @param {string} name the robot that is driven
   * @param {number} silent ms since the program sent a state
   */
  show(robots, name, silent) {
    const robot = robots[name];
    const fresh = robot !== undefined && !robot.lost && silent < OLD;
    this.status = fresh ? robot.status : silent < OLD ? "lost" : "no data";
    this.moving = fresh && isMoving(robot);
    this.deadman = fresh ? deadmanWord(robot.deadman) : "unknown";
    setText(byId("deadman"), this.deadman);
    const lamp = this.deadman === "held" ? "on" : this.deadman === "silent" ? "alarm" : "calm";
    setData(byId("deadman-lamp"), "tone", lamp);
    const limited = fresh && robot.limited !== "nothing" ? robot.limited : "";
    const limits = limited.split(", ").map((/** @type {string} */ one) => LIMITS[one] ?? one).join(", ");
    setText(byId("limited"), limited && `Limited: ${limits}`);
    show(byId("limited"), limited !== "");
    this.#banners(robots, name);
    const following = this.moving ? "moving" : "ready";
    setText(byId("status"), this.status === "following" ? following : WORDS[this.status] ?? this.status);
    setData(byId("status-lamp"), "tone", this.#tone(fresh));
  }

  /** @param {boolean} fresh */
  #tone(fresh) {
    if (!fresh || this.status === "fault" || (this.status === "tripped" && !this.#calm)) return "alarm";
    return this.status === "following" ? "on" : "calm";
  }

  /** Whether the pad was lost on purpose; then nothing is wrong. */
  get #calm() {
    return this.trip === "deadman_lost" && this.#loss.text !== "" && !this.#loss.alarm;
  }

  /**
   * Show faults and losses of every arm, and stops of the one that is driven.
   * @param {any} robots @param {string} name
   */
  #banners(robots, name) {
    const names = [name, ...Object.keys(robots).filter((one) => one !== name)].filter((one) => robots[one]);
    const called = (/** @type {string} */ one) => (names.length > 1 ? `${one}: ` : "");
    const faulty = names.find((one) => robots[one].fault);
    this.faulty = faulty ?? "";
    if (faulty !== undefined) {
      const { code, cause, remedy } = robots[faulty].fault;
      setText(byId("fault-cause"), `${called(faulty)}Fault: ${cause} (${code})`);
      const first = remedy && `${sentence(remedy).replace(/\.$/, "")}. `;
      setText(byId("fault-remedy"), first + (this.lease.mine ? RECOVER : this.#remedy(robots[faulty])));
    }
    show(byId("fault"), faulty !== undefined);
    show(byId("recover"), this.lease.mine);
    const stopped = names.find((one) => robots[one].lost || (one === name && isTripped(robots[one])));
    const trip = stopped === undefined ? "none" : (robots[stopped].trip ?? "lost");
    const isNew = trip !== "none" && this.trip === "none";
    this.trip = trip;
    if (isNew) {
      this.#trippedAt = performance.now();
      this.#since = this.#known ? `, ${new Date().toTimeString().slice(0, 8)}` : "";
    }
    this.#known = true;
    if (trip === "none" && performance.now() - this.#stoppedAt > STOPPING) this.#stopped = "";
    if (stopped !== undefined) {
      setText(byId("trip-text"), called(stopped) + this.#why(robots[stopped]));
      setText(byId("trip-remedy"), this.#remedy(robots[stopped]));
      byId("trip").classList.toggle("alarm", !this.#calm);
      if (isNew && !this.#calm && this.lease.mine && navigator.userActivation?.hasBeenActive) navigator.vibrate?.(200);
    }
    show(byId("trip"), stopped !== undefined);
  }

  /** Return why an arm is stopped. @param {any} robot */
  #why(robot) {
    if (robot.lost) return `No state of the arm: ${robot.lost}`;
    if (robot.trip === "stop") return `Stopped by STOP${this.#stopped && ` (${this.#stopped})`}`;
    if (this.#cause) return `Stopped: ${this.#cause.text}${this.#since}`;
    if (robot.trip === "deadman_lost" && this.#loss.text) return `${sentence(this.#loss.text)}${this.#since}`;
    const page = this.lease.rig?.drivable ? PAGE_TRIPS[robot.trip] : "";
    return `Stopped: ${page || robot.trip_text || robot.trip}${this.#since}`;
  }

  /** Return what to do after a trip. @param {any} robot */
  #remedy(robot) {
    if (robot.lost) return "Arm state unknown: use the robot's own stop if it moves.";
    const { mine, driver, rig } = this.lease;
    if (!mine) return rig?.drivable ? `${driver ? `View only: ${driver} can continue. ` : ""}${TAKE}` : `${this.lease.text}.`;
    if (this.trip === "device_lost") return `When the robot answers again: ${this.#resume()}`;
    return `${this.#cause ? `${this.#cause.remedy} ` : ""}${this.#resume()}`;
  }

  /** Whether the dead-man counts only after everything was released. */
  get mustRelease() {
    const stopped = this.trip !== "none" || this.faulty !== "";
    return this.waiting.length > 0 || (stopped && (this.held || this.deadman === "held"));
  }

  /** Return what makes the arm move again. */
  #resume() {
    if (!this.present) return "Click this page to continue.";
    return this.mustRelease ? this.#again() : `Hold ${this.holdName()} to continue.`;
  }

  /** That the network does not let this page hold anything, while it does not; "" otherwise. */
  get #slow() {
    const { length, at } = this.#measured.slow ?? { length: 0, at: -Infinity };
    return performance.now() - at < NEAR ? `: the network is too slow (${length.toFixed(0)} ms)` : "";
  }

  #again() {
    return `Release everything, then hold ${this.holdName()} again.`;
  }

  /**
   * Show what to do next, beside the button to hold.
   * @param {boolean} present @param {boolean} held @param {boolean} pushed whether something is pushed that moves the arm
   * @param {boolean} playing
   */
  advise(present, held, pushed, playing) {
    if (held && !this.held) this.#heldAt = performance.now();
    this.held = held;
    this.present = present;
    show(byId("focus"), this.lease.mine && !present);
    setText(byId("waiting"), this.#advice(present, held, pushed, playing));
    const strong = this.lease.mine && (this.mustRelease || (pushed && !held && !playing));
    setData(byId("waiting"), "tone", strong ? "strong" : null);
  }

  /** @param {boolean} present @param {boolean} held @param {boolean} pushed @param {boolean} playing */
  #advice(present, held, pushed, playing) {
    const hold = this.holdName();
    if (!this.lease.mine) {
      const free = this.lease.rig?.drivable && this.lease.driver === null;
      return free ? TAKE : `${this.lease.text}.`;
    }
    if (!present) return "Click this page to continue.";
    if (this.status === "lost" || this.status === "no data") return "Arm state unknown.";
    if (this.faulty) return 'The arm has a fault: press "Recover".';
    if (this.mustRelease || this.trip !== "none") return this.#resume();
    if (playing) return "The tour is playing.";
    if (!held) return pushed ? `Hold ${hold} too: the arm moves only while it is held.` : `Stopped. Hold ${hold} to move.`;
    if (this.deadman !== "held") return `Hold signal not received${this.#slow}`;
    // Held since before a session began; one that begins with the press takes a moment.
    if (this.status === "holding" && performance.now() - this.#heldAt > OLD) return this.#again();
    return this.moving ? "Moving" : "Ready";
  }

  /** Show a short note for some seconds. @param {string} text */
  notice(text) {
    setText(byId("notice-text"), sentence(text));
    show(byId("notice"), true);
    clearTimeout(this.#noticeTimer);
    this.#noticeTimer = setTimeout(() => show(byId("notice"), false), 6000);
  }
}

/** Whether a stop holds an arm. A fault has its own banner. @param {any} robot */
function isTripped(robot) {
  return robot.trip !== undefined && robot.trip !== "none" && !robot.fault;
}

const PATIENCE = 500; // ms until a stop that no state confirms has failed
const FLASH = 400; // ms that the button shows that it was pressed
const STOPPED = ["idle", "tripped", "fault"]; // statuses in which nothing moves before something is pressed or cleared

/** STOP: sent at once, and unconfirmed until the state of every arm shows it. */
export class Stopping {
  /** @param {import("./connection.js").Connection} connection @param {import("./status.js").Log} log */
  constructor(connection, log) {
    this.connection = connection;
    this.log = log;
    byId("alarm-close").addEventListener("click", () => this.#settle());
  }

  /** Time from which states may confirm the stop, s on the app's clock; null: none is open. @type {number | null} */
  #asked = null;
  #timer = 0;
  /** What still moves or does not answer. */
  #doubt = "";
  /** The newest state's time, s on the app's clock, and when it came, ms. */
  #t = -Infinity;
  #cameAt = 0;

  /** Stop every arm. */
  stop() {
    const sent = this.connection.send({ type: "stop" });
    this.#asked ??= this.#t + (performance.now() - this.#cameAt) / 1000;
    if (!sent) {
      this.log.add("STOP could not be sent: not connected");
      this.#alarm("STOP does not reach the arm", "There is no connection to the program.");
      return;
    }
    this.log.add("STOP was sent");
    setData(byId("stop"), "sent", "");
    setTimeout(() => setData(byId("stop"), "sent", null), FLASH);
    this.#doubt = "The program does not answer.";
    this.#timer ||= setTimeout(() => this.#fail(), PATIENCE);
  }

  /** Check whether a state confirms the stop. @param {any} state */
  addState(state) {
    this.#t = state.t;
    this.#cameAt = performance.now();
    if (this.#asked === null || state.t < this.#asked) return;
    this.#doubt = doubts(state.robots);
    if (this.#doubt) return;
    if (!byId("alarm").hidden) this.log.add("all arms have stopped");
    this.#settle();
  }

  #fail() {
    this.#timer = 0;
    this.log.add(`STOP was not confirmed: ${this.#doubt}`);
    this.#alarm("STOP was not confirmed", this.#doubt);
  }

  /** @param {string} title @param {string} text */
  #alarm(title, text) {
    setText(byId("alarm-title"), `${title}: use the robot's own stop`);
    setText(byId("alarm-text"), text);
    const { bottom } = byId("stop").parentElement.getBoundingClientRect();
    byId("alarm").style.top = `${bottom + 8}px`; // never over the button
    show(byId("alarm"), true);
  }

  #settle() {
    clearTimeout(this.#timer);
    this.#timer = 0;
    this.#asked = null;
    show(byId("alarm"), false);
  }
}

/** Return which arms may still move; "" for none. @param {Record<string, any>} robots of a state */
function doubts(robots) {
  const words = Object.entries(robots).map(([name, robot]) => {
    if (robot.lost) return `${name} does not answer.`;
    return STOPPED.includes(robot.status) ? "" : `${name} is ${robot.status}.`;
  });
  return words.filter(Boolean).join(" ");
}

const MAX_LINES = 200;
const RECENT = 6; // lines of which one that comes again is counted, with its newest time

/** The messages of the program, with the time of day. */
export class Log {
  constructor() {
    this.list = byId("log");
    /** From the app's clock to the time of day, s; null while unknown. @type {number | null} */
    this.shift = null;
  }

  /** Note that the app's clock is at `t` s now. @param {number} t */
  synchronise(t) {
    const shift = Date.now() / 1000 - t;
    const jumped = this.shift === null || Math.abs(shift - this.shift) > 1;
    if (jumped || shift < Number(this.shift)) this.shift = shift; // the fastest message is the most exact
  }

  /** Add a line. @param {string} text @param {number | null} [t] on the app's clock, s; null: now @returns {Date} its time */
  add(text, t = null) {
    const at = t === null || this.shift === null ? new Date() : new Date(1000 * (t + this.shift));
    const same = [...this.list.children].slice(-RECENT).find((one) => one.dataset.text === text);
    const count = same ? Number(same.dataset.count) + 1 : 1;
    same?.remove();
    const line = make("li");
    const time = make("time", "", at.toTimeString().slice(0, 8));
    time.dateTime = at.toISOString();
    line.append(time, make("span", "", count > 1 ? `${text} (${count} times)` : text));
    Object.assign(line.dataset, { text, count });
    const atEnd = this.list.scrollHeight - this.list.scrollTop - this.list.clientHeight < 40;
    this.list.append(line);
    while (this.list.childElementCount > MAX_LINES) this.list.firstElementChild.remove();
    if (atEnd) this.list.scrollTop = this.list.scrollHeight;
    return at;
  }

  /** Clear the log for a new socket: the program sends its last lines again. */
  clear() {
    this.list.replaceChildren();
    this.shift = null;
  }
}
