// A bar per joint: where it is between its limits, and where it is told to be.

import { byId, make, setData, setText } from "./dom.js";

/** One joint. */
class Row {
  /** @param {string} name @param {number} lower @param {number} upper @param {() => void} clicked */
  constructor(name, lower, upper, clicked) {
    this.lower = lower;
    this.span = upper - lower || 1;
    this.element = make("li");
    const button = make("button");
    button.type = "button";
    button.addEventListener("click", clicked);
    this.measured = make("i", "measured");
    this.target = make("i", "target");
    this.value = make("span", "value");
    const track = make("span", "track");
    track.append(this.measured, this.target);
    button.append(make("span", "name", name), track, this.value);
    button.title = `${name}: ${lower.toFixed(3)} to ${upper.toFixed(3)} rad`;
    this.element.append(button);
    this.button = button;
  }

  /** @param {number} q @param {number} set */
  show(q, set) {
    this.#move(this.measured, q);
    this.#move(this.target, set);
    setText(this.value, signed(q, 3));
    const share = (q - this.lower) / this.span;
    setData(this.element, "near", share < 0.03 || share > 0.97 ? "" : null);
  }

  /** @param {HTMLElement} mark @param {number} value rad */
  #move(mark, value) {
    const share = Math.min(1, Math.max(0, (value - this.lower) / this.span));
    const at = `translateX(${(100 * share).toFixed(1)}%)`;
    if (mark.dataset.at === at) return;
    mark.dataset.at = at;
    mark.style.transform = at;
  }
}

export class Joints {
  /** @param {(joint: number | null) => void} chosen */
  constructor(chosen) {
    this.chosen = chosen;
    /** @type {Row[]} */
    this.rows = [];
    /** @type {number | null} */
    this.joint = null;
  }

  /** Lay out the bars of an arm. @param {any} robot of hello */
  open(robot) {
    this.rows = robot.joints.map((/** @type {string} */ name, /** @type {number} */ k) => {
      return new Row(shortened(name, robot.joints), robot.lower[k], robot.upper[k], () => this.#choose(k));
    });
    this.rows.forEach((row, k) => (row.button.dataset.joint = String(k)));
    byId("joints").replaceChildren(...this.rows.map((row) => row.element));
    this.joint = null;
    this.#mark();
  }

  /** @param {any} robot of a state */
  show(robot) {
    this.rows.forEach((row, k) => row.show(robot.q[k], robot.q_set[k]));
  }

  /** @param {number} joint */
  #choose(joint) {
    this.joint = this.joint === joint ? null : joint;
    this.#mark();
    this.chosen(this.joint);
  }

  #mark() {
    this.rows.forEach((row, k) => row.button.setAttribute("aria-pressed", String(k === this.joint)));
  }
}

/** A joint's name without what all of them begin with. @param {string} name @param {string[]} all */
export function shortened(name, all) {
  let same = all.length > 1 ? name.length : 0;
  for (const other of all) while (!other.startsWith(name.slice(0, same))) same -= 1;
  while (same > 0 && /\d/.test(name[same - 1])) same -= 1; // never cut a number in two
  const rest = name.slice(same);
  return /^\d/.test(rest) ? `J${rest}` : rest;
}

/** A number whose sign takes as much room whether it is there or not. @param {number} value @param {number} digits */
export function signed(value, digits) {
  if (typeof value !== "number") return "–";
  const text = Math.abs(value).toFixed(digits);
  return (value < 0 && Number(text) !== 0 ? "−" : "\u2007") + text;
}
