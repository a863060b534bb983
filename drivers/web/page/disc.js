// A disc to drag on: two axes at once. The middle is 0, the rim is 1.

import { make, setText } from "./dom.js";
import { onPress } from "./press.js";

/** Share of the way to the rim, per axis, so that straight stays straight. Sticks get theirs from the program. */
export const DEAD = 0.08;
const REACH = 0.8; // where the rim counts as reached, of the disc's radius
const TRAVEL = 34; // how far the knob goes, percent of the disc

/** @param {number} share @param {number} dead @returns {number} -1..1 */
function shaped(share, dead) {
  const size = Math.abs(share);
  return size <= dead ? 0 : Math.sign(share) * Math.min(1, (size - dead) / (1 - dead));
}

export class Disc {
  /**
   * @param {HTMLElement} element
   * @param {() => boolean} enabled
   * @param {(x: number, y: number) => void} moved right and up are positive
   * @param {number} dead zone around the middle
   */
  constructor(element, enabled, moved, dead = 0) {
    this.element = element;
    this.dead = dead;
    this.moved = moved;
    this.knob = make("i", "knob");
    this.labels = ["up", "down", "left", "right"].map((side) => make("span", side));
    element.append(make("i", "cross"), ...this.labels, this.knob);
    this.forget = onPress(element, {
      down: (event) => {
        if (!enabled()) return false;
        this.#box = element.getBoundingClientRect();
        this.#follow(event);
      },
      move: (event) => this.#follow(event),
      up: () => moved(0, 0),
    });
  }

  #box = new DOMRect();
  #at = "";

  /** @param {PointerEvent} event */
  #follow(event) {
    const { left, top, width, height } = this.#box;
    let x = (2 * (event.clientX - left - width / 2)) / width / REACH;
    let y = (2 * (top + height / 2 - event.clientY)) / height / REACH;
    const size = Math.hypot(x, y);
    if (size > 1) [x, y] = [x / size, y / size];
    this.moved(shaped(x, this.dead), shaped(y, this.dead));
  }

  /** Show where the pad is, whoever pushes it. @param {number} x @param {number} y */
  show(x, y) {
    const at = `translate(${(TRAVEL * x).toFixed(1)}%, ${(-TRAVEL * y).toFixed(1)}%)`;
    if (at === this.#at) return;
    this.#at = at;
    this.knob.style.transform = at;
  }

  /**
   * What its two axes do, each as [negative, positive]; null for nothing.
   * @param {string[] | null} across @param {string[] | null} up
   */
  explain(across, up) {
    const texts = [up?.[1], up?.[0], across?.[0], across?.[1]];
    this.labels.forEach((label, place) => setText(label, texts[place] ?? ""));
    this.element.toggleAttribute("data-no-x", !across);
    this.element.toggleAttribute("data-no-y", !up);
    const words = texts.filter(Boolean).join(", ");
    this.element.setAttribute("role", "group");
    this.element.setAttribute("aria-label", `${this.element.dataset.disc}: ${words || "does nothing here"}`);
  }
}
