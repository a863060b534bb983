// The driving page's sign of life: the whole pad, 50 times a second, from the main thread.

const PERIOD = 20; // ms
const SOONEST = 8; // ms between two messages of a stick that is being moved
const STALL = 120; // ms; the servo gives up after 150

/**
 * Runs on the main thread on purpose: a page that hangs must look like a pad that is gone. Every message carries proof
 * of when the page was alive: the newest `t` that it got from the program, and how long ago that was.
 */
export class Heartbeat {
  /**
   * @param {import("./pad.js").Pad} pad
   * @param {import("./connection.js").Connection} connection
   * @param {() => boolean} mayDrive is the lease here, and the page in front?
   */
  constructor(pad, connection, mayDrive) {
    this.pad = pad;
    this.connection = connection;
    this.mayDrive = mayDrive;
    this.beats = 0;
    /**
     * Called before every beat: look at what sends no events (gamepads, keys that move the gripper).
     * @type {((dt: number) => void)[]}
     */
    this.before = [];
    /** Called with the length of a stall of this page, ms. @type {(ms: number) => void} */
    this.stalled = () => {};
    /** Time of the newest round trip, ms. @type {number | null} */
    this.roundTrip = null;
    pad.changed.push((edge) => this.#changed(edge));
  }

  #seen = 0;
  #seenAt = 0;
  #sentAt = -Infinity;
  #lastBeat = 0;
  #clogged = false;
  #running = false;
  #probe = /** @type {number | null} */ (null);

  start() {
    setInterval(() => this.#beat(), PERIOD);
  }

  /** The lease was granted at `t`, s on the app's clock. @param {number} t */
  granted(t) {
    this.#see(t);
    this.#probe = null;
    this.#running = false;
    this.#beat();
  }

  /** The program answered. @param {number} t */
  answered(t) {
    this.beats += 1;
    this.#see(t);
    if (this.#probe !== null) this.roundTrip = performance.now() - this.#probe;
    this.#probe = null;
  }

  /** Tell that the pad is gone. @param {"hidden" | "blur" | "closing" | "hands"} why */
  away(why) {
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
    for (const look of this.before) look(dt);
    const full = this.connection.buffered > 0;
    if (!(full && this.#clogged)) this.#send(now); // what waits to be sent is old by the time it is: let it drain
    this.#clogged = full;
  }

  /** @param {boolean} edge */
  #changed(edge) {
    const now = performance.now();
    if (!this.#running || !this.mayDrive() || this.#clogged) return;
    if (edge || now - this.#sentAt >= SOONEST) this.#send(now);
  }

  /** @param {number} now */
  #send(now) {
    this.#sentAt = now;
    if (this.#probe === null || now - this.#probe > 1000) this.#probe = now;
    const axes = this.pad.axes.map((value) => Math.round(value * 1e4) / 1e4);
    this.connection.send({
      type: "pad", seen: this.#seen, since: performance.now() - this.#seenAt, axes, buttons: this.pad.mask,
    });
  }
}
