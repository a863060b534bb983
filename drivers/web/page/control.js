// Which page is in control, and what that page may set: the arm, its speed, its axes, the scene.

import { byId, choose, segments, setData, setText, show } from "./dom.js";

/** The right to drive: one page has it at a time, the others are view only. */
export class Lease {
  /** @param {import("./connection.js").Connection} connection */
  constructor(connection) {
    this.connection = connection;
    /** Whether this page is in control. */
    this.mine = false;
    /** @type {string | null} */
    this.driver = null;
    this.page = "";
    this.rig = /** @type {any} */ (null);
    /** Name of the driven arm, if there are several. */
    this.arm = "";
    /** @type {(t: number) => void} */
    this.granted = () => {};
    this.ended = () => {};
    /** Called with the reason when this page has lost control, unless it released it. @type {(why: string) => void} */
    this.taken = () => {};
    byId("lease").addEventListener("click", () => this.#request(!this.mine));
    document.addEventListener("visibilitychange", () => this.#takeOnce());
  }

  #asked = false;
  #known = false;
  #released = false;

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
    if (had && !this.mine && !this.#released) this.taken(message.why || "this page is no longer in control");
    if (this.mine && !had) this.granted(message.t);
    if (!this.mine && had) this.ended();
    this.#released = false;
    this.#takeOnce();
    this.paint();
  }

  /** Allow this page to take control by itself, as after loading: a new link was opened in it. */
  linkOpened() {
    this.disconnected();
    this.#asked = false;
  }

  /** Note that the socket is gone, and control with it. */
  disconnected() {
    const had = this.mine;
    this.mine = this.#known = false;
    this.driver = null;
    if (had) this.ended();
    this.paint();
  }

  /** Text that names the page in control. */
  get text() {
    if (!this.rig) return "";
    const of = this.arm && ` of ${this.arm}`;
    if (!this.rig.drivable) return `View only: ${this.rig.driven_by ?? "another pad"} is in control${of}`;
    if (this.mine) return `You are in control${of}`;
    return this.driver ? `View only: ${this.driver} is in control${of}` : "No page is in control";
  }

  /** Take control if no page has it, once after opening; after that only a click does. */
  #takeOnce() {
    if (this.#asked || !this.#known || document.visibilityState !== "visible") return;
    this.#asked = true;
    if (this.driver === null && this.rig?.drivable) this.#request(true);
  }

  /** @param {boolean} take */
  #request(take) {
    this.#released = !take;
    this.connection.send({ type: "lease", take });
  }

  /** Show the state; also when another arm is driven. */
  paint() {
    setData(document.documentElement, "driving", this.mine ? "" : null);
    const button = byId("lease");
    setText(button, this.mine ? "Release control" : "Take control");
    button.title = this.mine ? "Let another page take control" : this.text;
    button.classList.toggle("primary", !this.mine);
    show(button, Boolean(this.rig?.drivable));
    setText(byId("who"), this.text);
    byId("who").title = this.text;
  }
}

const FRAMES = ["base", "tool"]; // labels; the program's name of "tool" is tcp

/** The settings that the program offers; the page in control may change them. */
export class Settings {
  /**
   * @param {import("./connection.js").Connection} connection @param {import("./control.js").Lease} lease
   * @param {import("./arm.js").ArmPanel} panel @param {() => boolean} held whether the dead-man is pressed here
   * @param {(text: string) => void} refuse
   */
  constructor(connection, lease, panel, held, refuse) {
    this.connection = connection;
    this.lease = lease;
    this.panel = panel;
    this.held = held;
    this.refuse = refuse;
    this.speed = byId("speed");
    panel.picked = (name) => this.#pick(name);
    segments(byId("frame"), FRAMES, (name) => this.#set("frame", name === "tool" ? "tcp" : "base"));
    this.speed.addEventListener("input", () => this.#send("speed", Number(this.speed.value) / 100));
    for (const type of ["change", "pointerup"]) this.speed.addEventListener(type, () => this.speed.blur());
    byId("reset").addEventListener("click", () => this.#send("scene", "reset"));
  }

  /** Newest view of the program. @type {any} */
  #view = null;
  /** The arm that the labels are for; programs may send no more than those. */
  #labelled = "";
  /** Names of all arms. @type {string[]} */
  #robots = [];

  /** Name of the driven arm; "" if unknown. */
  get robot() {
    return this.#view?.robot ?? (this.#labelled || (this.#robots.length === 1 ? this.#robots[0] : ""));
  }

  /** Whether this page may change a setting. @param {string} name */
  may(name) {
    return this.lease.mine && Boolean(this.#view?.settings.includes(name));
  }

  /** Start again for another program, or for the same one. @param {any} rig of hello */
  open(rig) {
    this.#view = null;
    this.#labelled = "";
    this.#robots = rig.robots.map((/** @type {any} */ robot) => robot.name);
    this.paint();
  }

  /** @param {any} labels */
  explain({ robot }) {
    this.#labelled = robot ?? "";
    this.#changed();
  }

  /** @param {any} view */
  heard(view) {
    this.#view = view;
    this.#changed();
  }

  #changed() {
    if (this.robot) this.panel.show(this.robot);
    this.paint();
  }

  /** Choose an arm: the page in control drives it, another one only shows it. @param {string} name */
  #pick(name) {
    if (this.lease.mine) this.#set("robot", name);
    else this.panel.show(name);
  }

  /** Request another meaning of the controls. @param {string} name @param {string} value */
  #set(name, value) {
    if (this.held()) this.refuse("Release the controls first.");
    else this.#send(name, value);
  }

  /** @param {string} name @param {string | number} value */
  #send(name, value) {
    if (this.may(name)) this.connection.send({ type: "setting", name, value });
  }

  /** Show the settings; also when control changes. */
  paint() {
    const { robot, lease } = this;
    const several = this.#robots.length > 1;
    lease.arm = several ? robot || "an arm" : "";
    if (lease.mine && robot) this.panel.show(robot);
    setText(byId("driven"), several ? robot : "");
    show(byId("robots"), several && (!lease.mine || this.may("robot")));
    show(byId("reset"), this.may("scene"));
    show(byId("settings"), Boolean(this.#view?.settings.length));
    const note = this.#view?.note ?? "";
    setText(byId("driving-note"), note);
    show(byId("driving"), note !== "");
    if (!this.#view) return;
    const percent = Math.round(100 * this.#view.speed);
    this.speed.max = String(Math.round(100 * this.#view.speed_max));
    if (document.activeElement !== this.speed) this.speed.value = String(percent);
    this.speed.disabled = !this.may("speed");
    setText(byId("speed-share"), `${percent} %`);
    choose(byId("frame"), this.#view.frame === "tcp" ? "tool" : "base");
    setData(byId("frame"), "fixed", this.may("frame") ? null : "");
  }
}
