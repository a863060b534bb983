// What matters at once: what the arm does, the dead-man as the servo sees it, stops and faults.

import { byId, setData, setText, show } from "./dom.js";

const SILENT = 0.15; // s, as in the servo
const OLD = 500; // ms without a state until the page says so
const LOSS = "the pad is gone: ";

/** The dead-man in one word. @param {any} deadman of a robot's state */
export function deadmanWord(deadman) {
  if (!deadman) return "none";
  if (!deadman.connected) return "no pad";
  if (deadman.age > SILENT) return "silent";
  return deadman.held ? "held" : "released";
}

/** @param {string} status */
function tone(status) {
  if (status === "following") return "on";
  return ["tripped", "fault", "lost"].includes(status) ? "alarm" : "calm";
}

/** What to do after a trip. @param {string} trip */
function remedy(trip) {
  const again = "let go of the dead-man and press it again";
  if (trip === "device_lost") return `When the robot answers again: ${again}.`;
  if (trip === "deadman_lost" || trip === "deadman_silent") return `When the pad is back: ${again}.`;
  return `To go on, ${again}.`;
}

export class Status {
  /** @param {import("./connection.js").Connection} connection @param {import("./lease.js").Lease} lease */
  constructor(connection, lease) {
    this.lease = lease;
    this.waiting = /** @type {string[]} */ ([]);
    this.faulty = "";
    this.deadman = "unknown";
    this.status = "unknown";
    this.trip = "none";
    /** Why the pad was lost last. */
    this.loss = "";
    byId("recover").addEventListener("click", () => connection.send({ type: "recover", robot: this.faulty }));
  }

  #noticeTimer = 0;

  /** The program said something. @param {string} text */
  told(text) {
    if (text.startsWith(LOSS)) this.loss = text.slice(LOSS.length);
  }

  /**
   * @param {any} robots of a state @param {string} name the robot that is shown
   * @param {number} silent ms since the program sent a state
   */
  show(robots, name, silent) {
    const robot = robots[name];
    const fresh = robot !== undefined && !robot.lost && silent < OLD;
    const status = fresh ? robot.status : silent < OLD ? "lost" : "no news";
    this.status = status;
    setText(byId("status"), status);
    setData(byId("status-lamp"), "tone", fresh ? tone(status) : "alarm");
    this.deadman = fresh ? deadmanWord(robot.deadman) : "unknown";
    setText(byId("deadman"), this.deadman);
    const lamp = this.deadman === "held" ? "on" : this.deadman === "silent" ? "alarm" : "calm";
    setData(byId("deadman-lamp"), "tone", lamp);
    const limited = fresh && robot.limited !== "nothing" ? robot.limited : "";
    setText(byId("limited"), limited && `held back: ${limited}`);
    show(byId("limited"), limited !== "");
    this.#banners(robots, name);
  }

  /**
   * The arm that is shown comes first, then whichever else has something to say.
   * @param {any} robots @param {string} name
   */
  #banners(robots, name) {
    const names = [name, ...Object.keys(robots).filter((one) => one !== name)];
    const called = (/** @type {string} */ one) => (names.length > 1 ? `${one}: ` : "");
    const faulty = names.find((one) => robots[one]?.fault);
    this.faulty = faulty ?? "";
    if (faulty !== undefined) {
      const { code, cause, remedy: mend } = robots[faulty].fault;
      setText(byId("fault-cause"), `${called(faulty)}Fault: ${cause} (${code})`);
      setText(byId("fault-remedy"), mend);
    }
    show(byId("fault"), faulty !== undefined);
    show(byId("recover"), this.lease.mine);
    const stopped = names.find((one) => stopOf(robots[one], this.loss) !== "");
    const trip = stopped === undefined ? "none" : (robots[stopped].trip ?? "lost");
    if (stopped !== undefined) {
      setText(byId("trip-text"), `${called(stopped)}${stopOf(robots[stopped], this.loss)}`);
      setText(byId("trip-remedy"), robots[stopped].lost ? "What the arm does is not known." : remedy(trip));
    }
    show(byId("trip"), stopped !== undefined);
    const isNew = trip !== "none" && this.trip === "none";
    if (isNew && this.lease.mine && navigator.userActivation?.hasBeenActive) navigator.vibrate?.(200);
    this.trip = trip;
  }

  /**
   * The line beside the button to hold: what a person should do next.
   * @param {boolean} present @param {boolean} held @param {boolean} playing
   */
  advise(present, held, playing) {
    show(byId("focus"), this.lease.mine && !present);
    setText(byId("waiting"), this.#advice(present, held, playing));
    setData(byId("waiting"), "tone", this.lease.mine && this.waiting.length ? "strong" : null);
  }

  /** @param {boolean} present @param {boolean} held @param {boolean} playing */
  #advice(present, held, playing) {
    if (!this.lease.mine) {
      const free = this.lease.rig?.drivable && this.lease.driver === null;
      return free ? "press Drive from here" : `${this.lease.words}, this page watches`;
    }
    if (!present) return "click on this page to go on";
    if (this.waiting.length) return `let go of: ${this.waiting.join(", ")}`;
    if (playing) return "the tour plays";
    if (this.faulty) return "the arm has a fault";
    if (this.trip !== "none") return held ? "let go, then press again" : "press again to go on";
    if (!held) return "the arm holds still";
    if (this.deadman !== "held") return "the servo does not see it held";
    return this.status === "holding" ? "let go, then press again" : "the arm follows"; // held since before a session began
  }

  /** A short note. @param {string} text */
  notice(text) {
    setText(byId("notice-text"), text);
    show(byId("notice"), true);
    clearTimeout(this.#noticeTimer);
    this.#noticeTimer = setTimeout(() => show(byId("notice"), false), 6000);
  }
}

/**
 * Why an arm stands, in words; "" for no reason, or for a fault, which has its own banner.
 * @param {any} robot @param {string} loss why the pad was lost last, as the program told
 */
function stopOf(robot, loss) {
  if (!robot) return "";
  if (robot.lost) return `No fresh state: ${robot.lost}`;
  if (robot.trip === "none" || robot.fault) return "";
  if (robot.trip === "stop") return "Stopped: somebody pressed STOP, or the program did";
  if (robot.trip === "deadman_lost" && loss) return `Stopped: ${loss}`;
  return `Stopped: ${robot.trip_text || robot.trip}`;
}
