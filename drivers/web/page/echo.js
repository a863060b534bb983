// Does the browser still pass on what hands do? Its main process may hang while this page, a process of its own, goes on.

const LIMIT = 0.17; // s without an answer

/**
 * Says something to itself by a way that leads through the browser's main process, as every key and touch does.
 *
 * Where a browser has no such way, nothing is ever missed.
 */
export class Echo {
  constructor() {
    const name = `hal-console-${performance.timeOrigin}-${Math.random()}`; // other pages have channels of their own
    try {
      this.#mouth = new BroadcastChannel(name);
      this.#ear = new BroadcastChannel(name);
      this.#ear.onmessage = () => this.#heard();
    } catch {
      this.#mouth = null; // an old browser, or one that forbids it
    }
  }

  /** @type {BroadcastChannel | null} */ #mouth;
  /** @type {BroadcastChannel | undefined} */ #ear;
  #works = false;
  #silent = 0;

  /**
   * Ask once more. Time counts as in Repeats: answers that wait while this page hangs are not missing.
   * @param {number} dt s since the last call; 0: after a pause @returns {boolean} is an answer overdue?
   */
  overdue(dt) {
    this.#silent = dt ? this.#silent + dt : 0;
    this.#mouth?.postMessage(0);
    return this.#works && this.#silent > LIMIT;
  }

  #heard() {
    this.#works = true;
    this.#silent = 0;
  }
}
