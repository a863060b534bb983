// Which arm is driven, how fast and in which frame; the page in control may change what the program offers.

import { byId, choose, segments, setData, setText, show } from "./dom.js";

const FRAMES = ["base", "tool"]; // as people call them; the program says tcp

export class Settings {
  /**
   * @param {import("./connection.js").Connection} connection @param {import("./lease.js").Lease} lease
   * @param {import("./facts.js").Facts} facts @param {() => boolean} held is the dead-man pressed here?
   * @param {(text: string) => void} refuse
   */
  constructor(connection, lease, facts, held, refuse) {
    this.connection = connection;
    this.lease = lease;
    this.facts = facts;
    this.held = held;
    this.refuse = refuse;
    this.speed = byId("speed");
    facts.picked = (name) => this.#pick(name);
    segments(byId("frame"), FRAMES, (name) => this.#set("frame", name === "tool" ? "tcp" : "base"));
    this.speed.addEventListener("input", () => this.#send("speed", Number(this.speed.value) / 100));
    for (const type of ["change", "pointerup"]) this.speed.addEventListener(type, () => this.speed.blur());
    byId("reset").addEventListener("click", () => this.#send("scene", "reset"));
  }

  /** What the program showed last. @type {any} */
  #view = null;
  /** The arm that the labels are about, for programs that show no more than those. */
  #labelled = "";
  /** Names of all arms. @type {string[]} */
  #robots = [];

  /** Name of the arm that is driven; "" where the program does not say. */
  get robot() {
    return this.#view?.robot ?? (this.#labelled || (this.#robots.length === 1 ? this.#robots[0] : ""));
  }

  /** May this page change that setting? @param {string} name */
  may(name) {
    return this.lease.mine && Boolean(this.#view?.settings.includes(name));
  }

  /** Another program, or the same one again. @param {any} rig of hello */
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
    if (this.robot) this.facts.show(this.robot);
    this.paint();
  }

  /** An arm was chosen: the page in control drives it, another one only shows it. @param {string} name */
  #pick(name) {
    if (this.lease.mine) this.#set("robot", name);
    else this.facts.show(name);
  }

  /** Ask for another meaning of the controls. @param {string} name @param {string} value */
  #set(name, value) {
    if (this.held()) this.refuse("Release the controls first.");
    else this.#send(name, value);
  }

  /** @param {string} name @param {string | number} value */
  #send(name, value) {
    if (this.may(name)) this.connection.send({ type: "setting", name, value });
  }

  /** Show it; also when the lease changes hands. */
  paint() {
    const { robot, lease } = this;
    const several = this.#robots.length > 1;
    lease.arm = several ? robot || "an arm" : "";
    if (lease.mine && robot) this.facts.show(robot);
    setText(byId("driven"), several ? robot : "");
    show(byId("robots"), several && (!lease.mine || this.may("robot")));
    show(byId("reset"), this.may("scene"));
    show(byId("settings"), this.#view !== null);
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
