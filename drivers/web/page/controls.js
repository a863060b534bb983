// The controls on the page: discs, slider and buttons; what they press, what they are called, what they show.

import { byId, make, onPress, setAttribute, setData, setText, show } from "./dom.js";
import { ACTIONS, BUTTONS, KEYS } from "./keys.js";
import { AXIS, BIT, DISCS } from "./pad.js";

/** Buttons that are on the page only if they have a meaning. */
const RARE = ["l2", "l3", "r3", "touchpad"];

/** Dead zone per axis, as a share of the way to the rim. Sticks get theirs from the program. */
const DEAD = 0.08;
const REACH = 0.8; // share of the radius at which the rim counts as reached
const TRAVEL = 34; // travel of the knob, percent of the disc

/** @param {number} share @param {number} dead @returns {number} -1..1 */
function shaped(share, dead) {
  const size = Math.abs(share);
  return size <= dead ? 0 : Math.sign(share) * Math.min(1, (size - dead) / (1 - dead));
}

/** A disc to drag on, two axes at once: the middle is 0, the rim is 1. */
class Disc {
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

  /** Show the position of the pad, whichever source pushes it. @param {number} x @param {number} y */
  show(x, y) {
    const at = `translate(${(TRAVEL * x).toFixed(1)}%, ${(-TRAVEL * y).toFixed(1)}%)`;
    if (at === this.#at) return;
    this.#at = at;
    this.knob.style.transform = at;
  }

  /**
   * Label the two axes, each as [negative, positive]; null for an axis without a meaning.
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

/**
 * The gripper's slider, r2: drag up to close, down to open. It stays where it is released.
 *
 * A tap changes nothing: the slider moves by as much as the finger does, so that touching the wrong end drops nothing.
 */
class Slider {
  /**
   * @param {HTMLElement} element
   * @param {() => boolean} enabled
   * @param {() => number} place present position, 0 open .. 1 closed
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

  /** Mark the gripper's present width. @param {number | null} place 0 open .. 1 closed; null: unknown */
  mark(place) {
    const rounded = place === null ? -1 : Math.round(200 * place) / 200;
    if (rounded === this.#width) return;
    this.#width = rounded;
    this.at.hidden = rounded < 0;
    this.at.style.bottom = `calc(var(--thumb) / 2 + ${rounded} * (100% - var(--thumb)))`;
    setAttribute(this.element, "aria-valuetext", rounded < 0 ? "" : `gripper ${Math.round(100 * rounded)} % closed`);
  }

  /** Label the ends. @param {string[] | null} ends meanings of 0 and 1 */
  explain(ends) {
    const [open, closed] = (ends ?? []).map((text) => text.replace(/^gripper:?\s*/, ""));
    setText(/** @type {Element} */ (this.element.querySelector(".bottom")), open ?? "");
    setText(/** @type {Element} */ (this.element.querySelector(".top")), closed ?? "");
    this.element.toggleAttribute("data-idle", !ends);
  }
}

/** All controls of the page, as one source of the pad. */
export class Controls {
  /** @param {import("./pad.js").Pad} pad @param {() => boolean} enabled whether this page drives */
  constructor(pad, enabled) {
    this.pad = pad;
    this.enabled = enabled;
    this.source = pad.source();
    /** Names of what holds the dead-man, besides the button on the page. */
    this.holdKeys = () => "Space";
    /** Whether what is held moves nothing until it was released. */
    this.mustRelease = false;
    this.hold = byId("hold");
    this.home = byId("home");
    this.slider = new Slider(byId("gripper"), enabled, () => pad.grip, (place) => pad.setGrip(place));
    /** @type {(() => void)[]} */
    const forget = [
      this.slider.forget,
      this.#wire(this.hold, enabled, (on) => pad.hold("page", on)),
      this.#wire(this.home, () => enabled() && pad.held, (on) => pad.goHome("page", on)),
      this.#wireJoints(byId("joints")),
    ];
    /** @type {[Disc, number, number][]} */
    this.discs = [];
    for (const element of this.#all("[data-disc]")) forget.push(this.#wireDisc(element));
    /** @type {[HTMLElement, number][]} */
    this.buttons = [];
    for (const name of BUTTONS) if (name !== "r2") forget.push(this.#wireButton(name));
    pad.released.push(() => forget.forEach((one) => one()));
    pad.changed.push(() => this.#paintSoon());
    this.explain({ deadman: pad.deadman, home: null, controls: {} });
  }

  #painting = false;
  #explained = false;

  /** @param {string} selector @returns {NodeListOf<HTMLElement>} */
  #all(selector) {
    return document.querySelectorAll(selector);
  }

  /** @param {HTMLElement} element @param {() => boolean} may @param {(on: boolean) => void} press */
  #wire(element, may, press) {
    return onPress(element, { down: () => (may() ? press(true) : false), up: () => press(false) });
  }

  /** @param {HTMLElement} element */
  #wireDisc(element) {
    const [across, up] = DISCS[/** @type {keyof typeof DISCS} */ (element.dataset.disc)].map((name) => AXIS[name]);
    const disc = new Disc(element, this.enabled, (x, y) => {
      this.source.axes[across] = x;
      this.source.axes[up] = y;
      this.pad.update();
    }, element.dataset.disc === "dpad" ? DEAD : 0);
    this.discs.push([disc, across, up]);
    return disc.forget;
  }

  /** Wire a button; one that has no place of its own is made below the others. @param {string} name */
  #wireButton(name) {
    const [found] = this.#all(`[data-button="${name}"]`);
    const element = found ?? make("button", "control");
    if (!found) {
      element.type = "button";
      element.dataset.button = name;
      this.#all(".buttons")[0].append(element);
    }
    const note = make("small");
    note.append(make("span", "pad", name.length === 2 ? name.toUpperCase() : name), " ");
    element.append(make("b"), note);
    const keys = Object.keys(KEYS.buttons).filter((key) => KEYS.buttons[key] === name);
    if (keys.length) {
      note.append(make("kbd", "", KEYS.legend.find(([, control]) => control === name)[0].split(" / ")[0]));
      setAttribute(element, "aria-keyshortcuts", keys.map((key) => key.replace(/^Key|^Digit/, "")).join(" "));
    }
    const press = (/** @type {boolean} */ on) => {
      if (name in AXIS) this.source.axes[AXIS[name]] = on ? 1 : 0; // a trigger; its bit follows
      else if (on) this.source.mask |= BIT[name];
      else this.source.mask &= ~BIT[name];
      this.pad.update();
    };
    this.buttons.push([element, BIT[name]]);
    return this.#wire(element, this.enabled, press);
  }

  /** Let one button at a time jog its joint; the list outlives its rows. @param {HTMLElement} joints */
  #wireJoints(joints) {
    let jogged = "";
    return onPress(joints, {
      down: (event) => {
        const { jog, way } = /** @type {HTMLElement} */ (event.target).dataset;
        if (!jog || jogged || !this.enabled()) return false;
        this.source.axes[AXIS[(jogged = jog)]] = Number(way);
        this.pad.update();
      },
      up: () => {
        this.source.axes[AXIS[jogged]] = 0;
        jogged = "";
        this.pad.update();
      },
    });
  }

  /** Label every control with what it does. @param {any} labels */
  explain({ deadman, home, controls }) {
    this.#explained ||= Object.keys(controls).length > 0;
    /** Return the meaning of a control, or null. @param {string} name @returns {string[] | null} */
    const meaning = (name) => (name === deadman ? null : (controls[name] ?? null));
    const actions = Object.keys(controls).filter((name) => ACTIONS.includes(controls[name].join()));
    const moving = Object.keys(controls).filter((name) => !actions.includes(name));
    setData(document.documentElement, "explained", this.#explained ? "" : null);
    setData(document.documentElement, "jogs", "joint_1" in controls ? "" : null);
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
   * Label a button. One that does nothing is hidden; the dead-man and the way home have buttons of their own.
   * @param {HTMLElement} element @param {string} deadman @param {string | null} home
   * @param {(name: string) => string[] | null} meaning
   */
  #name(element, deadman, home, meaning) {
    const name = String(element.dataset.button);
    const found = meaning(name);
    const text = found ? found[found.length - 1] : "";
    setText(/** @type {Element} */ (element.querySelector("b")), text);
    setAttribute(element, "aria-label", text ? `${text} (${name})` : `${name}: does nothing here`);
    const useful = found !== null || (!this.#explained && !RARE.includes(name));
    show(element, useful && name !== deadman && name !== home);
  }

  /** Fill the table of keys. @param {(name: string) => string[] | null} meaning @param {string | null} home */
  #legend(meaning, home) {
    /** @type {[string, string][]} */
    const rows = [["Space", "hold to move"]];
    for (const [keys, control] of KEYS.legend) {
      const found = meaning(control);
      if (control === home) continue; // it has its own key
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

  /** Release the gripper's slider because the program waits for it: it stays where it is and cannot be released by hand. */
  releaseGrip() {
    this.slider.forget();
    this.pad.setGrip(0);
  }

  #paintSoon() {
    if (this.#painting) return;
    this.#painting = true;
    requestAnimationFrame(() => {
      this.#painting = false;
      this.paint();
    });
  }

  /** Show the state of the pad, whichever source presses it. */
  paint() {
    const { axes, mask, held } = this.pad;
    for (const [disc, across, up] of this.discs) disc.show(axes[across], axes[up]);
    for (const [element, bit] of this.buttons) setData(element, "pressed", mask & bit ? "" : null);
    this.slider.show(this.pad.deadman === "r2" ? 0 : axes[AXIS.r2]);
    setData(this.hold, "pressed", held ? "" : null);
    setAttribute(this.hold, "aria-pressed", String(held));
    setText(/** @type {Element} */ (this.hold.querySelector("b")), !held ? "HOLD TO MOVE" : this.mustRelease ? "RELEASE" : "HELD");
    setText(byId("hold-keys"), !held ? this.holdKeys() : this.mustRelease ? "" : "Release to stop");
    setAttribute(this.home, "aria-disabled", String(!held || this.mustRelease));
    const homing = this.pad.home !== null && (mask & BIT[this.pad.home]) !== 0;
    setData(this.home, "pressed", homing ? "" : null);
    setText(byId("home-note"), held && !this.mustRelease ? "hold until it arrives" : "hold to move first");
  }
}
