// The controls on the page: what they press, what they are called, and what they show.

import { DEAD, Disc } from "./disc.js";
import { byId, make, setAttribute, setData, setText, show } from "./dom.js";
import { ACTIONS, AXIS, BIT, DISCS, LEGEND } from "./names.js";
import { onPress } from "./press.js";
import { Slider } from "./slider.js";

export class Drive {
  /** @param {import("./pad.js").Pad} pad @param {() => boolean} enabled does this page drive? */
  constructor(pad, enabled) {
    this.pad = pad;
    this.enabled = enabled;
    this.source = pad.source();
    /** What holds, besides the button on the page. */
    this.ways = () => "Space";
    this.hold = byId("hold");
    this.home = byId("home");
    this.slider = new Slider(byId("gripper"), enabled, () => pad.grip, (place) => pad.setGrip(place));
    /** @type {(() => void)[]} */
    const forget = [this.slider.forget, this.#holding(), this.#homing()];
    /** @type {[Disc, number, number][]} */
    this.discs = [];
    for (const element of this.#all("[data-disc]")) forget.push(this.#disc(element));
    /** @type {[HTMLElement, number][]} */
    this.buttons = [];
    for (const element of this.#all("[data-button]")) forget.push(this.#button(element));
    pad.released.push(() => forget.forEach((one) => one()));
    pad.changed.push(() => this.#soon());
    this.explain({ deadman: pad.deadman, home: null, controls: {} });
  }

  #waiting = false;
  #explained = false;

  /** @param {string} selector @returns {NodeListOf<HTMLElement>} */
  #all(selector) {
    return document.querySelectorAll(selector);
  }

  #holding() {
    return onPress(this.hold, {
      down: () => (this.enabled() ? this.pad.hold("page", true) : false),
      up: () => this.pad.hold("page", false),
    });
  }

  #homing() {
    return onPress(this.home, {
      down: () => (this.enabled() && this.pad.held ? this.pad.goHome("page", true) : false),
      up: () => this.pad.goHome("page", false),
    });
  }

  /** @param {HTMLElement} element */
  #disc(element) {
    const [across, up] = DISCS[/** @type {keyof typeof DISCS} */ (element.dataset.disc)].map((name) => AXIS[name]);
    const disc = new Disc(element, this.enabled, (x, y) => {
      this.source.axes[across] = x;
      this.source.axes[up] = y;
      this.pad.update();
    }, element.dataset.disc === "dpad" ? DEAD : 0);
    this.discs.push([disc, across, up]);
    return disc.forget;
  }

  /** @param {HTMLElement} element */
  #button(element) {
    const name = String(element.dataset.button);
    const press = (/** @type {boolean} */ on) => {
      if (name in AXIS) this.source.axes[AXIS[name]] = on ? 1 : 0; // a trigger; its bit follows
      else if (on) this.source.mask |= BIT[name];
      else this.source.mask &= ~BIT[name];
      this.pad.update();
    };
    this.buttons.push([element, BIT[name]]);
    return onPress(element, { down: () => (this.enabled() ? press(true) : false), up: () => press(false) });
  }

  /** Write on every control what it does. @param {any} labels */
  explain({ deadman, home, controls }) {
    this.#explained ||= Object.keys(controls).length > 0;
    /** What a control does, or null. @param {string} name @returns {string[] | null} */
    const meaning = (name) => (name === deadman ? null : (controls[name] ?? null));
    const actions = Object.keys(controls).filter((name) => ACTIONS.includes(controls[name].join()));
    const moving = Object.keys(controls).filter((name) => !actions.includes(name));
    setData(document.documentElement, "explained", this.#explained ? "" : null);
    this.pad.explain(deadman, home, actions, moving);
    for (const [disc] of this.discs) {
      const [across, up] = DISCS[/** @type {keyof typeof DISCS} */ (disc.element.dataset.disc)];
      disc.explain(meaning(across), meaning(up));
      disc.element.toggleAttribute("data-idle", this.#explained && !meaning(across) && !meaning(up));
    }
    this.slider.explain(meaning("r2"));
    for (const [element] of this.buttons) this.#name(element, deadman, home, meaning);
    show(this.home, home !== null);
    this.#legend(meaning, home);
    this.paint();
  }

  /**
   * Buttons that do nothing are hidden; the dead-man and the way home have one of their own.
   * @param {HTMLElement} element @param {string} deadman @param {string | null} home
   * @param {(name: string) => string[] | null} meaning
   */
  #name(element, deadman, home, meaning) {
    const name = String(element.dataset.button);
    const found = meaning(name);
    const text = found ? found[found.length - 1] : "";
    setText(/** @type {Element} */ (element.querySelector("b")), text);
    setAttribute(element, "aria-label", text ? `${text} (${name})` : `${name}: does nothing here`);
    const useful = found !== null || (!this.#explained && !("rare" in element.dataset));
    show(element, useful && name !== deadman && name !== home);
  }

  /** @param {(name: string) => string[] | null} meaning @param {string | null} home */
  #legend(meaning, home) {
    /** @type {[string, string][]} */
    const rows = [["Space", "hold to move"]];
    for (const [keys, control] of LEGEND) {
      const found = meaning(control);
      if (control === home) continue; // it has a key of its own
      if (found) rows.push([keys, control === "r2" ? "close / open" : [...found].reverse().join(" / ")]);
      else if (!this.#explained) rows.push([keys, control.replace("_", " ")]);
    }
    if (home) rows.push(["Home", "drive home, with Space held"]);
    rows.push(["Shift", "slower"], ["Esc, Backspace", "STOP"]);
    const body = /** @type {Element} */ (document.querySelector("#legend tbody"));
    body.replaceChildren(...rows.map(([keys, text]) => {
      const row = make("tr");
      const head = make("th");
      head.append(make("kbd", "", keys));
      row.append(head, make("td", "", text));
      return row;
    }));
  }

  /** Mark the gripper's present width on its slider. @param {number | null} place 0 open .. 1 closed */
  mark(place) {
    this.slider.mark(place);
  }

  /** The program waits for it: a slider that stays where it is cannot be let go of by hand. */
  letGoOfGrip() {
    this.slider.forget();
    this.pad.setGrip(0);
  }

  #soon() {
    if (this.#waiting) return;
    this.#waiting = true;
    requestAnimationFrame(() => {
      this.#waiting = false;
      this.paint();
    });
  }

  /** Show the pad as it is, whoever presses it. */
  paint() {
    const { axes, mask, held } = this.pad;
    for (const [disc, across, up] of this.discs) disc.show(axes[across], axes[up]);
    for (const [element, bit] of this.buttons) setData(element, "pressed", mask & bit ? "" : null);
    this.slider.show(this.pad.deadman === "r2" ? 0 : axes[AXIS.r2]);
    setData(this.hold, "pressed", held ? "" : null);
    setAttribute(this.hold, "aria-pressed", String(held));
    setText(/** @type {Element} */ (this.hold.querySelector("b")), held ? "HELD" : "HOLD TO MOVE");
    setText(byId("hold-keys"), held ? "Release to stop" : this.ways());
    setAttribute(this.home, "aria-disabled", String(!held));
    const homing = this.pad.home !== null && (mask & BIT[this.pad.home]) !== 0;
    setData(this.home, "pressed", homing ? "" : null);
    setText(byId("home-note"), held ? "hold until it is there" : "hold to move first");
  }
}
