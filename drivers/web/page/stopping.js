// STOP: asked for at once, and not believed until every arm shows it.

import { byId, setData, setText, show } from "./dom.js";

const PATIENCE = 500; // ms until a stop that no state confirms has failed
const FLASH = 400; // ms that the button shows that it was pressed
const STANDS = ["idle", "tripped", "fault"]; // nothing moves these before a person presses or clears something

export class Stopping {
  /** @param {import("./connection.js").Connection} connection @param {import("./log.js").Log} log */
  constructor(connection, log) {
    this.connection = connection;
    this.log = log;
    byId("alarm-close").addEventListener("click", () => this.#settle());
  }

  /** States from then on may confirm it, s on the app's clock; null: no stop is open. @type {number | null} */
  #asked = null;
  #timer = 0;
  /** What still moves or does not answer, in words. */
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

  /** @param {any} state */
  heard(state) {
    this.#t = state.t;
    this.#cameAt = performance.now();
    if (this.#asked === null || state.t < this.#asked) return;
    this.#doubt = doubts(state.robots);
    if (this.#doubt) return;
    if (!byId("alarm").hidden) this.log.add("every arm has stopped now");
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

/** Which arms may still move, in words; "" for none. @param {Record<string, any>} robots of a state */
function doubts(robots) {
  const words = Object.entries(robots).map(([name, robot]) => {
    if (robot.lost) return `${name} does not answer.`;
    return STANDS.includes(robot.status) ? "" : `${name} is ${robot.status}.`;
  });
  return words.filter(Boolean).join(" ");
}
