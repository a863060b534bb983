// Is the page in front of a person? Only then may it drive.

/** @typedef {"hidden" | "blur" | "closing"} Why */

export class Presence {
  constructor() {
    this.present = this.#look();
    /** @type {(why: Why) => void} */
    this.left = () => {};
    this.came = () => {};
    addEventListener("blur", () => this.#leave("blur"));
    addEventListener("pagehide", () => this.#leave("closing"));
    addEventListener("focus", () => this.#update());
    addEventListener("pageshow", () => this.#update());
    document.addEventListener("freeze", () => this.#leave("hidden"));
    document.addEventListener("visibilitychange", () => this.#update());
  }

  /** Look once more, for an event that never came. @returns {boolean} */
  check() {
    this.#update();
    return this.present;
  }

  #look() {
    return document.visibilityState === "visible" && document.hasFocus();
  }

  #update() {
    if (!this.#look()) this.#leave(document.visibilityState === "visible" ? "blur" : "hidden");
    else if (!this.present) {
      this.present = true;
      this.came();
    }
  }

  /** @param {Why} why */
  #leave(why) {
    if (!this.present) return;
    this.present = false;
    this.left(why);
  }
}
