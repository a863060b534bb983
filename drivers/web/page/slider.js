// The gripper's slider, r2: drag up to close, down to open. It stays where it is let go of.

import { setAttribute, setText } from "./dom.js";
import { onPress } from "./press.js";

/**
 * A tap changes nothing: the slider moves by as much as the finger does, so that nobody drops what the gripper holds
 * by touching the wrong end.
 */
export class Slider {
  /**
   * @param {HTMLElement} element
   * @param {() => boolean} enabled
   * @param {() => number} place where it is, 0 open .. 1 closed
   * @param {(place: number) => void} moved
   */
  constructor(element, enabled, place, moved) {
    this.element = element;
    this.thumb = /** @type {HTMLElement} */ (element.querySelector(".thumb"));
    this.at = /** @type {HTMLElement} */ (element.querySelector(".at"));
    let height = 1;
    let from = 0;
    let start = 0;
    this.forget = onPress(element, {
      down: (event) => {
        if (!enabled()) return false;
        height = element.clientHeight - this.thumb.clientHeight;
        from = event.clientY;
        start = place();
      },
      move: (event) => moved(start + (from - event.clientY) / Math.max(1, height)),
      up: () => {},
    });
  }

  #shown = NaN;
  #width = NaN;

  /** @param {number} place 0..1 */
  show(place) {
    if (place === this.#shown) return;
    this.#shown = place;
    this.thumb.style.bottom = `calc(${place} * (100% - var(--thumb)))`;
    setAttribute(this.element, "aria-valuenow", String(Math.round(100 * place)));
  }

  /** Mark where the gripper is. @param {number | null} place 0 open .. 1 closed; null: unknown */
  mark(place) {
    const rounded = place === null ? -1 : Math.round(200 * place) / 200;
    if (rounded === this.#width) return;
    this.#width = rounded;
    this.at.hidden = rounded < 0;
    this.at.style.bottom = `calc(var(--thumb) / 2 + ${rounded} * (100% - var(--thumb)))`;
    setAttribute(this.element, "aria-valuetext", rounded < 0 ? "" : `gripper ${Math.round(100 * rounded)} % closed`);
  }

  /** @param {string[] | null} ends what 0 and 1 mean */
  explain(ends) {
    const [open, closed] = (ends ?? []).map((text) => text.replace(/^gripper:?\s*/, ""));
    setText(/** @type {Element} */ (this.element.querySelector(".bottom")), open ?? "");
    setText(/** @type {Element} */ (this.element.querySelector(".top")), closed ?? "");
    this.element.toggleAttribute("data-idle", !ends);
  }
}
