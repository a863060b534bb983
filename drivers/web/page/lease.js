// Which page drives: only one does at a time, the others watch.

import { byId, setData, setText, show } from "./dom.js";

export class Lease {
  /** @param {import("./connection.js").Connection} connection */
  constructor(connection) {
    this.connection = connection;
    /** Does this page drive? */
    this.mine = false;
    /** @type {string | null} */
    this.driver = null;
    this.page = "";
    this.rig = /** @type {any} */ (null);
    /** Name of the arm that is driven, where there are several. */
    this.arm = "";
    /** @type {(t: number) => void} */
    this.granted = () => {};
    this.ended = () => {};
    byId("lease").addEventListener("click", () => this.#ask(!this.mine));
    byId("lost-close").addEventListener("click", () => show(byId("lost"), false));
    document.addEventListener("visibilitychange", () => this.#takeOnce());
  }

  #asked = false;
  #known = false;
  #letGo = false;

  /** @param {any} hello */
  hello(hello) {
    this.page = hello.name;
    this.rig = hello.rig;
    this.paint();
  }

  /** @param {any} message */
  heard(message) {
    const had = this.mine;
    this.mine = message.you;
    this.driver = message.driver;
    this.#known = true;
    if (this.mine) show(byId("lost"), false);
    else if (had) this.#lost(message.why);
    if (this.mine && !had) this.granted(message.t);
    if (!this.mine && had) this.ended();
    this.#letGo = false;
    this.#takeOnce();
    this.paint();
  }

  /** A link was opened in this page: it may take control as a page that was just loaded. */
  opened() {
    this.disconnected();
    this.#asked = false;
  }

  /** The socket is gone, and the lease with it. */
  disconnected() {
    const had = this.mine;
    this.mine = this.#known = false;
    this.driver = null;
    if (had) this.ended();
    this.paint();
  }

  /** Who drives, for people. */
  get words() {
    if (!this.rig) return "";
    const of = this.arm && ` of ${this.arm}`;
    if (!this.rig.drivable) return `View only: ${this.rig.driven_by ?? "another pad"} is in control${of}`;
    if (this.mine) return `You are in control${of}`;
    return this.driver ? `View only: ${this.driver} is in control${of}` : "No page is in control";
  }

  /** A page that was just opened takes a lease that nobody has; after that only a click does. */
  #takeOnce() {
    if (this.#asked || !this.#known || document.visibilityState !== "visible") return;
    this.#asked = true;
    if (this.driver === null && this.rig?.drivable) this.#ask(true);
  }

  /** @param {boolean} take */
  #ask(take) {
    this.#letGo = !take;
    this.connection.send({ type: "lease", take });
  }

  /** @param {string} why */
  #lost(why) {
    if (this.#letGo) return;
    const text = why || "This page is no longer in control";
    setText(byId("lost-text"), `${text[0].toUpperCase()}${text.slice(1)}.`);
    show(byId("lost"), true);
  }

  /** Show it; also when another arm is driven. */
  paint() {
    setData(document.documentElement, "driving", this.mine ? "" : null);
    const button = byId("lease");
    setText(button, this.mine ? "Stop driving" : "Take control");
    button.title = this.mine ? "Give up control, so that another page can take it" : this.words;
    button.classList.toggle("primary", !this.mine);
    show(button, Boolean(this.rig?.drivable));
    setText(byId("who"), this.words);
    byId("who").title = this.words;
  }
}
