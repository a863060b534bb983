// The socket to the program: opened again after a loss, unless that is of no use.

const FIRST = 500; // ms until the first new try
const LONGEST = 5000;
const GROWTH = 1.7;
const SILENCE = 2000; // ms; the program speaks 20 times a second

export const REFUSED = 4403;
export const TOO_MANY = 4409;
export const ENDED = 4410;

/** Trying again after these would only fail again. */
const FINAL = [REFUSED, TOO_MANY, ENDED]; // the next run has another link

/**
 * A WebSocket to `path` with the link's token, or null where the token cannot be one.
 * @param {string} path @param {string} token
 */
export function socketTo(path, token) {
  if (!token) return null;
  const scheme = location.protocol === "https:" ? "wss:" : "ws:";
  try {
    return new WebSocket(`${scheme}//${location.host}${path}`, ["hal.v1", token]);
  } catch {
    return null; // not made of the letters that a token has
  }
}

/** The token in the page's address: it stands behind the #, which browsers never send. */
export function tokenOfPage() {
  return location.hash.slice(1);
}

/**
 * The live socket.
 *
 * `heard` gets every message; `lost` gets the close code and the time until the next try, ms, or null for none.
 */
export class Connection {
  constructor() {
    /** Is a socket open on which the program has said hello? */
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

  /** Bytes that were handed over, and have not left yet. */
  get buffered() {
    return this.#socket?.bufferedAmount ?? 0;
  }

  /** Connect now, whatever was before. */
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

  /** Send, if there is somebody to send to. @param {object} message @returns {boolean} */
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

  /** The connection is of use: the next loss is a new one. */
  proved() {
    this.#wait = FIRST;
  }

  /** A link that was cut tells nobody: what is silent for long is gone. */
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
