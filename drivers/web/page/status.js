// What matters at once: what the arm does, the dead-man as the servo sees it, stops and faults.

import { byId, setData, setText, show } from "./dom.js";

const SILENT = 0.12; // s, as in the servo
const OLD = 500; // ms without a state until the page says so
const STOPPING = 1000; // ms; a state that shows a stop comes after the word that STOP was pressed
const MOVING = 0.005; // rad/s; slower joints are at rest

/** Status of a robot -> its word. @type {Record<string, string>} */
const WORDS = { idle: "idle", holding: "stopped", tripped: "stopped" };
/** What holds a motion back -> its word. @type {Record<string, string>} */
const LIMITS = { speed: "joint speed", "tcp speed": "tool speed" };

/** Trip -> its words where a page is the pad. @type {Record<string, string>} */
const PAGE_TRIPS = {
  deadman_silent: "the page in control gave no sign of life",
  deadman_lost: "the page in control was disconnected",
};

/** The dead-man in one word. @param {any} deadman of a robot's state */
export function deadmanWord(deadman) {
  if (!deadman) return "none";
  if (!deadman.connected) return "no pad";
  if (deadman.age > SILENT) return "silent";
  return deadman.held ? "held" : "released";
}

/** A text as a sentence. @param {string} text */
const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1)}`;

/** @param {any} robot */
function isMoving(robot) {
  return robot.dq?.some((/** @type {number} */ speed) => Math.abs(speed) > MOVING) ?? false;
}

export class Status {
  /** @param {import("./connection.js").Connection} connection @param {import("./lease.js").Lease} lease */
  constructor(connection, lease) {
    this.lease = lease;
    this.waiting = /** @type {string[]} */ ([]);
    this.faulty = "";
    this.deadman = "unknown";
    this.status = "unknown";
    this.moving = false;
    this.trip = "none";
    /** What a person holds: "Space", "L2" or "the button". */
    this.hold = () => "Space";
    byId("recover").addEventListener("click", () => connection.send({ type: "recover", robot: this.faulty }));
  }

  #noticeTimer = 0;
  /** Why the pad was lost last, and whether nobody intended that. */
  #loss = { text: "", alarm: false };
  /** Who pressed STOP last, and when; "" where that is unknown. */
  #stopped = "";
  #stoppedAt = -Infinity; // ms

  /** The program said something. @param {any} said @param {Date} at */
  told({ text, loss, stop }, at) {
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
    this.status = fresh ? robot.status : silent < OLD ? "lost" : "no news";
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

  /** Was the pad lost by somebody's intention? Then nothing is wrong. */
  get #calm() {
    return this.trip === "deadman_lost" && this.#loss.text !== "" && !this.#loss.alarm;
  }

  /**
   * Faults and losses of every arm, stops of the one that is driven.
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
      setText(byId("fault-remedy"), remedy);
    }
    show(byId("fault"), faulty !== undefined);
    show(byId("recover"), this.lease.mine);
    const stopped = names.find((one) => robots[one].lost || (one === name && isTripped(robots[one])));
    const trip = stopped === undefined ? "none" : (robots[stopped].trip ?? "lost");
    const isNew = trip !== "none" && this.trip === "none";
    this.trip = trip;
    if (trip === "none" && performance.now() - this.#stoppedAt > STOPPING) this.#stopped = "";
    if (stopped !== undefined) {
      setText(byId("trip-text"), called(stopped) + this.#why(robots[stopped]));
      setText(byId("trip-remedy"), robots[stopped].lost ? "Arm state unknown." : this.#remedy());
      byId("trip").classList.toggle("alarm", !this.#calm);
      if (isNew && !this.#calm && this.lease.mine && navigator.userActivation?.hasBeenActive) navigator.vibrate?.(200);
    }
    show(byId("trip"), stopped !== undefined);
  }

  /** Why an arm stands, in words. @param {any} robot */
  #why(robot) {
    if (robot.lost) return `No state of the arm: ${robot.lost}`;
    if (robot.trip === "stop") return `Stopped by STOP${this.#stopped && ` (${this.#stopped})`}`;
    if (robot.trip === "deadman_lost" && this.#loss.text) return sentence(this.#loss.text);
    const page = this.lease.rig?.drivable ? PAGE_TRIPS[robot.trip] : "";
    return `Stopped: ${page || robot.trip_text || robot.trip}`;
  }

  /** What to do after a trip. */
  #remedy() {
    if (!this.lease.mine) return "The page in control can continue.";
    const again = this.deadman === "held" ? `release ${this.hold()}, then hold it again` : `hold ${this.hold()} to continue`;
    if (this.trip === "device_lost") return `When the robot answers again, ${again}.`;
    return `${sentence(again)}.`;
  }

  /**
   * The line beside the button to hold: what a person should do next.
   * @param {boolean} present @param {boolean} held @param {boolean} pushed is something pushed that moves the arm?
   * @param {boolean} playing
   */
  advise(present, held, pushed, playing) {
    show(byId("focus"), this.lease.mine && !present);
    setText(byId("waiting"), this.#advice(present, held, pushed, playing));
    const strong = this.lease.mine && (this.waiting.length > 0 || (pushed && !held && !playing));
    setData(byId("waiting"), "tone", strong ? "strong" : null);
  }

  /** @param {boolean} present @param {boolean} held @param {boolean} pushed @param {boolean} playing */
  #advice(present, held, pushed, playing) {
    const hold = this.hold();
    if (!this.lease.mine) {
      const free = this.lease.rig?.drivable && this.lease.driver === null;
      return free ? 'Press "Take control" to drive.' : `${this.lease.words}.`;
    }
    if (!present) return "Click this page to continue.";
    if (this.waiting.length) return `Release first: ${this.waiting.join(", ")}`;
    if (playing) return "The tour is playing.";
    if (this.faulty) return "The arm has a fault.";
    const again = `Release ${hold}, then hold it again.`;
    if (this.trip !== "none") return held ? again : `Stopped. Hold ${hold} to continue.`;
    if (!held) return pushed ? `Hold ${hold} too: the arm moves only while it is held.` : `Stopped. Hold ${hold} to move.`;
    if (this.deadman !== "held") return "Hold signal not received";
    if (this.status === "holding") return again; // held since before a session began
    return this.moving ? "Moving" : "Ready";
  }

  /** A short note. @param {string} text */
  notice(text) {
    setText(byId("notice-text"), sentence(text));
    show(byId("notice"), true);
    clearTimeout(this.#noticeTimer);
    this.#noticeTimer = setTimeout(() => show(byId("notice"), false), 6000);
  }
}

/** Does a stop keep an arm where it is? A fault has a banner of its own. @param {any} robot */
function isTripped(robot) {
  return robot.trip !== undefined && robot.trip !== "none" && !robot.fault;
}
