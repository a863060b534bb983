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
    this.#paint();
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
    this.#paint();
  }

  /** The socket is gone, and the lease with it. */
  disconnected() {
    const had = this.mine;
    this.mine = this.#known = false;
    this.driver = null;
    if (had) this.ended();
    this.#paint();
  }

  /** Who drives, for people. */
  get words() {
    if (!this.rig) return "";
    if (!this.rig.drivable) return `${this.rig.driven_by ?? "another pad"} drives`;
    if (this.mine) return `you drive (${this.page})`;
    return this.driver ? `${this.driver} drives` : "nobody drives";
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
    setText(byId("lost-text"), `This page no longer drives${why ? `: ${why}` : ""}`);
    show(byId("lost"), true);
  }

  #paint() {
    setData(document.documentElement, "driving", this.mine ? "" : null);
    const button = byId("lease");
    setText(button, this.mine ? "Let go" : "Drive from here");
    button.title = this.mine ? "Let another page drive" : this.words;
    button.classList.toggle("primary", !this.mine);
    show(button, Boolean(this.rig?.drivable));
    setText(byId("who"), this.words);
    byId("who").title = this.words;
  }
}
