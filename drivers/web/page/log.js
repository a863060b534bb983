// What the program tells, with the time of day.

import { byId, make } from "./dom.js";

const MOST = 200; // lines that are kept

export class Log {
  constructor() {
    this.list = byId("log");
    /** From the app's clock to the time of day, s; null while unknown. @type {number | null} */
    this.shift = null;
  }

  /** The app's clock says `t` s now. @param {number} t */
  synchronise(t) {
    const shift = Date.now() / 1000 - t;
    const jumped = this.shift === null || Math.abs(shift - this.shift) > 1;
    if (jumped || shift < Number(this.shift)) this.shift = shift; // the quickest message is the truest
  }

  /** @param {string} text @param {number | null} [t] on the app's clock, s; null: now @returns {Date} */
  add(text, t = null) {
    const at = t === null || this.shift === null ? new Date() : new Date(1000 * (t + this.shift));
    const line = make("li");
    const time = make("time", "", at.toTimeString().slice(0, 8));
    time.dateTime = at.toISOString();
    line.append(time, make("span", "", text));
    const atEnd = this.list.scrollHeight - this.list.scrollTop - this.list.clientHeight < 40;
    this.list.append(line);
    while (this.list.childElementCount > MOST) this.list.firstElementChild.remove();
    if (atEnd) this.list.scrollTop = this.list.scrollHeight;
    return at;
  }

  /** A new socket: the program sends its last lines again. */
  clear() {
    this.list.replaceChildren();
    this.shift = null;
  }
}
