// The connection to the program: the live socket, which is opened again after a loss, and the overlay without one.

import { byId, setText, show } from "./dom.js";

const FIRST = 500; // ms until the first new try
const LONGEST = 5000;
const GROWTH = 1.7;
const SILENCE = 2000; // ms; the program sends 20 states a second

// Close codes of the server.
const REFUSED = 4403;
const TOO_MANY = 4409;
const ENDED = 4410;

/** Codes after which another try would only fail again: the next run has another link. */
const FINAL = [REFUSED, TOO_MANY, ENDED];

/**
 * Open a WebSocket to `path` with the link's token; null if the token cannot be one.
 * @param {string} path @param {string} token
 */
export function socketTo(path, token) {
  if (!token) return null;
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  try {
    return new WebSocket(`${scheme}//${location.host}${path}`, ["hal.v1", token]);
  } catch {
    return null; // it has characters that a token cannot have
  }
}

/** Return the token in the page's address. It follows the #, which browsers never send. */
export function tokenOfPage() {
  return location.hash.slice(1);
}

/**
 * The live socket.
 *
 * `heard` gets every message; `lost` gets the close code, its reason, and the time until the next try (ms, or null for none).
 */
export class Connection {
  constructor() {
    /** Whether a socket is open on which the program has sent its hello. */
    this.connected = false;
    /** @type {(message: any) => void} */
    this.heard = () => {};
    /** @type {(code: number, reason: string, retry: number | null) => void} */
    this.lost = () => {};
    setInterval(() => this.#watch(), 250);
  }

  /** @type {WebSocket | null} */ #socket = null;
  #wait = FIRST;
  #heardAt = 0;
  #timer = 0;

  /** Bytes that were handed to the browser and are not sent yet. */
  get buffered() {
    return this.#socket?.bufferedAmount ?? 0;
  }

  /** Connect now, and drop any connection before. */
  open() {
    clearTimeout(this.#timer);
    this.#drop();
    const socket = socketTo("/live", tokenOfPage());
    if (!socket) return this.#end(REFUSED, "");
    this.#socket = socket;
    this.#heardAt = performance.now();
    socket.onmessage = (event) => this.#take(event.data);
    socket.onclose = (event) => this.#end(event.code, event.reason);
  }

  /** Send a message; returns false if there is no connection. @param {object} message @returns {boolean} */
  send(message) {
    if (!this.#socket || this.#socket.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  /** @param {string} data */
  #take(data) {
    this.#heardAt = performance.now();
    const message = JSON.parse(data);
    if (message.type === "hello") this.connected = true;
    this.heard(message);
  }

  /** Note that the connection works: the next loss starts with short waits again. */
  proved() {
    this.#wait = FIRST;
  }

  /** Give up a connection that has been silent for too long: a cut link closes no socket. */
  #watch() {
    const patience = this.connected ? SILENCE : 2 * LONGEST;
    if (this.#socket && performance.now() - this.#heardAt > patience) this.#end(1006, "");
  }

  /** @param {number} code @param {string} reason */
  #end(code, reason) {
    this.#drop();
    const slow = code >= 4400;
    const retry = FINAL.includes(code) ? null : slow ? LONGEST : this.#wait;
    this.#wait = Math.min(LONGEST, this.#wait * GROWTH);
    if (retry !== null) this.#timer = setTimeout(() => this.open(), retry);
    this.lost(code, reason, retry);
  }

  #drop() {
    const socket = this.#socket;
    this.#socket = null;
    this.connected = false;
    if (!socket) return;
    socket.onmessage = socket.onclose = null;
    socket.close();
  }
}

/** Close code -> title and advice of the overlay. @type {Record<number, [string, string]>} */
const ENDINGS = {
  [REFUSED]: ["this link is not valid", "Use the newest link in the terminal."],
  [TOO_MANY]: ["too many pages are open", "Close one of the others, then try again."],
  [ENDED]: ["the program has ended", "Start it again and open the new link that it prints."],
};

/** The cover of the page while there is no connection: nothing on it is live then. */
export class Overlay {
  /** @param {() => void} again */
  constructor(again) {
    byId("again").addEventListener("click", again);
  }

  /**
   * @param {number} code the socket's close code @param {string} reason
   * @param {number | null} retry ms until the next try
   * @param {{drove: boolean, watched: boolean, real: boolean, saved: number | null}} before what this page did until
   *   now; `saved`: number of episodes if a recording was done
   */
  show(code, reason, retry, { drove, watched, real, saved }) {
    const lost = [lostTitle(drove, watched), lostText(drove, watched, real)];
    const [title, text] = saved === null ? ENDINGS[code] ?? lost : finished(saved, real && code !== ENDED);
    setText(byId("overlay-title"), title);
    setText(byId("overlay-text"), text);
    const closed = code >= 4400 && !(code in ENDINGS) && reason ? `Closed by the program: ${reason}. ` : "";
    setText(byId("overlay-next"), closed + (retry === null || saved !== null ? "" : "Reconnecting..."));
    show(byId("again"), code === TOO_MANY);
    show(byId("overlay"), true);
  }
}

/**
 * Return title and text for a program that ended after its recording was done.
 * @param {number} saved episodes @param {boolean} doubtful whether a real arm may still be driven
 */
function finished(saved, doubtful) {
  const own = doubtful ? " Use the robot's own stop if the arm moves." : "";
  return [
    `the program has finished: ${saved} episode${saved === 1 ? "" : "s"} saved`,
    `Start it again and open the new link that it prints.${own}`,
  ];
}

/** @param {boolean} drove @param {boolean} watched */
function lostTitle(drove, watched) {
  if (drove) return "connection lost: the arm has been stopped";
  return watched ? "connection lost: nothing here is live" : "no connection to the program";
}

/** @param {boolean} drove @param {boolean} watched @param {boolean} real */
function lostText(drove, watched, real) {
  const own = real ? " Use the robot's own stop if it moves." : "";
  if (drove) return `The arm stops when the connection is lost.${own}`;
  if (watched) return `STOP does not reach the arm from here.${own}`;
  return "Check that the program is running, and that this is the newest link in the terminal.";
}
