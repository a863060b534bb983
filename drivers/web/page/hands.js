// A hand that lets go must be seen to: nothing may come between it and the page unnoticed.

import { Echo } from "./echo.js";
import { Repeats } from "./repeats.js";

/** The menu and a drag keep keys and buttons for themselves; the page hears nothing of those that are let go of. */
const TAKES_HANDS = ["contextmenu", "dragstart"];

export class Hands {
  /** @param {import("./pad.js").Pad} pad @param {import("./keyboard.js").Keyboard} keyboard */
  constructor(pad, keyboard) {
    this.pad = pad;
    this.keyboard = keyboard;
    this.repeats = new Repeats();
    this.echo = new Echo();
    /** What is held may have been let go of long ago. @type {(why: string) => void} */
    this.lost = () => {};
    for (const type of TAKES_HANDS) addEventListener(type, (event) => event.preventDefault(), true);
    addEventListener("pointerdown", (event) => this.#menu(event), true);
  }

  /** Before every beat. @param {number} dt s */
  look(dt) {
    const ceased = this.repeats.ceased(dt) && this.keyboard.holds;
    const overdue = this.echo.overdue(dt) && this.pad.held;
    if (ceased) this.lost("this window lost the keyboard: all controls released");
    else if (overdue) this.lost("the browser hung: all controls released");
  }

  /** With Shift, Firefox opens its menu without asking. @param {PointerEvent} event */
  #menu(event) {
    if (event.pointerType === "mouse" && event.button === 2 && event.shiftKey) this.pad.reset();
  }
}
