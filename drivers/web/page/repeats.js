// A held key repeats itself. One that ceases, though nobody let it go, went to somebody else.

const SURE = 2; // repetitions until a key counts as one that repeats
const LIMIT = 0.3; // s without a repetition until it has ceased, at least
const PERIODS = 4; // and at least so many of this keyboard's own periods: a slow one takes seconds

/**
 * Watches the keyboard's repetition, for a locked screen or a screenshot tool may take all keys and no event tells.
 *
 * Only the newest key repeats, and not on every keyboard: the watch begins when repetitions were seen, and ends with
 * whatever may end them by right, until they are seen again.
 */
export class Repeats {
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
   * Time went by; to be called with no more of it than this page was awake for, or a page that hung for a moment would
   * take the events that still wait for missing ones.
   * @param {number} dt s @returns {boolean} has the newest key ceased? Told once.
   */
  ceased(dt) {
    if (this.#count < SURE) return false;
    this.#silent += dt;
    if (this.#silent <= Math.max(LIMIT, PERIODS * this.#longest)) return false;
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
