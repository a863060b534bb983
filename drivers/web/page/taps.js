// A press that moves nothing lasts long enough to be seen.

const SHORTEST = 80; // ms; an app looks 50 times a second, and a tap on a trackpad may be over before it does

/** Which of the pad's buttons are pressed: those that may be prolonged stay so for a while. */
export class Taps {
  /** @param {() => void} ended a press is over that was prolonged */
  constructor(ended) {
    this.ended = ended;
  }

  #pressed = 0;
  /** Bit of a button whose press is young -> the timer that ends that. @type {Map<number, number>} */
  #young = new Map();

  /**
   * @param {number} pressed mask of the buttons that are down
   * @param {number} may mask of those that may be prolonged; one that no longer may is let go of at once
   * @returns {number} mask of the buttons that count
   */
  look(pressed, may) {
    const fresh = pressed & ~this.#pressed & may;
    this.#pressed = pressed;
    for (const bit of this.#young.keys()) if (!(bit & may)) this.#end(bit);
    for (let rest = fresh; rest; rest &= rest - 1) this.#begin(rest & -rest);
    return [...this.#young.keys()].reduce((mask, bit) => mask | bit, pressed);
  }

  /** Nothing is prolonged any more. */
  forget() {
    for (const bit of this.#young.keys()) this.#end(bit);
  }

  /** @param {number} bit */
  #begin(bit) {
    this.#end(bit);
    this.#young.set(bit, setTimeout(() => {
      this.#young.delete(bit);
      this.ended();
    }, SHORTEST));
  }

  /** @param {number} bit */
  #end(bit) {
    clearTimeout(this.#young.get(bit));
    this.#young.delete(bit);
  }
}
