// A gamepad that the browser offers (Gamepad API) as a source of the pad.

import { byId, setData, setText } from "./dom.js";
import { AXIS, BIT } from "./pad.js";

const NEAR = 0.25; // share of the travel up to which a control counts as released
const BUTTON_ORDER = [
  "south", "east", "west", "north", "l1", "r1", "l2", "r2", "select", "start", "l3", "r3", null, null, null, null,
  "home", "touchpad",
];
const [UP, DOWN, LEFT, RIGHT] = [12, 13, 14, 15];

/**
 * Only pads with the standard mapping are used: of others it is unknown which button is which. A pad counts after all
 * of it was released once, because browsers show a pad only when a button on it is pressed.
 */
export class BrowserGamepad {
  /** @param {import("./pad.js").Pad} pad @param {(text: string) => void} lost */
  constructor(pad, lost) {
    this.pad = pad;
    this.lost = lost;
    this.source = pad.source();
    /** Whether its dead-man counts by itself. Not on a real arm: a wireless pad that dies keeps its last state here. */
    this.mayHold = true;
    pad.released.push(() => (this.#free = false));
    addEventListener("gamepadconnected", () => this.describe());
    addEventListener("gamepaddisconnected", () => this.read());
    setInterval(() => this.describe(), 1000);
  }

  /** @type {number | null} */ #index = null;
  #free = false;

  /** Whether the dead-man of a gamepad counts. */
  get holds() {
    return this.#index !== null && this.mayHold;
  }

  /** Read the present state. */
  read() {
    const found = this.#admit();
    if (!found) {
      if (this.#index !== null) this.#lose();
      return;
    }
    this.source.clear();
    this.source.mayHold = this.mayHold;
    if (this.#free) read(found, this.source);
    this.pad.update();
  }

  /** Show which gamepad there is. */
  describe() {
    setText(byId("gamepad"), this.#words());
    setData(document.documentElement, "gamepad", this.#index === null ? null : "");
  }

  #words() {
    if (!navigator.getGamepads) return "This browser offers no gamepads at this address.";
    const found = this.#admit();
    if (found) {
      const name = found.id.replace(/\s*\(.*\)\s*$/, "") || found.id;
      if (!this.#free) return `${name}: release all its sticks and buttons first.`;
      if (!this.mayHold) return `${name}. On a real arm its dead-man is not enough: hold Space or the button as well.`;
      return `${name}: ${this.pad.deadman.toUpperCase()} is the dead-man.`;
    }
    const other = navigator.getGamepads().find((one) => one?.connected);
    if (other) return `${other.id} is not used: this browser does not know its layout.`;
    return "No gamepad detected. Plug one in and press one of its buttons.";
  }

  /** Return the gamepad, if there is one; #free is whether it counts by now. @returns {Gamepad | null} */
  #admit() {
    const found = this.#find();
    if (!found) return null;
    if (found.index !== this.#index) {
      this.#index = found.index;
      this.#free = false;
    }
    this.#free ||= atRest(found);
    return found;
  }

  /** @returns {Gamepad | null} */
  #find() {
    const pads = (navigator.getGamepads?.() ?? []).filter((one) => one?.connected && one.mapping === "standard");
    return pads.find((one) => one?.index === this.#index) ?? (this.#index === null ? pads[0] : null) ?? null;
  }

  #lose() {
    this.#index = null;
    this.pad.reset();
    this.lost("gamepad disconnected: all controls released");
  }
}

/** @param {Gamepad} found */
function atRest(found) {
  const centred = found.axes.slice(0, 4).every((value) => Math.abs(value) <= NEAR);
  return centred && found.buttons.every((one) => one.value <= NEAR && !one.pressed);
}

/** @param {Gamepad} found @param {import("./pad.js").Source} source */
function read(found, source) {
  const [leftX = 0, leftY = 0, rightX = 0, rightY = 0] = found.axes;
  const value = (/** @type {number} */ place) => found.buttons[place]?.value ?? 0;
  const { axes } = source;
  axes[AXIS.left_x] = leftX;
  axes[AXIS.left_y] = -leftY; // the browser's axes point down
  axes[AXIS.right_x] = rightX;
  axes[AXIS.right_y] = -rightY;
  axes[AXIS.l2] = value(6);
  axes[AXIS.r2] = value(7);
  axes[AXIS.dpad_x] = value(RIGHT) - value(LEFT);
  axes[AXIS.dpad_y] = value(UP) - value(DOWN);
  BUTTON_ORDER.forEach((name, place) => {
    if (name && found.buttons[place]?.pressed && name !== "l2" && name !== "r2") source.mask |= BIT[name];
  });
}
