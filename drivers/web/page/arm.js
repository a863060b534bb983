// The panel of an arm: joints, tool, gripper, timing of its servo, and the age of all that.

import { byId, choose, make, remember, remembered, segments, setAttribute, setData, setText } from "./dom.js";
import { Plot, shortened, signed } from "./plot.js";

/** Unit of joints -> its share of a radian, and digits. @type {Record<string, [number, number]>} */
const UNITS = { rad: [1, 3], deg: [180 / Math.PI, 1] };

/** The bar of one joint: measured and target position between its limits; a bar is as long as the joint's range. */
class JointBar {
  /** @param {string} name @param {number} k @param {number} lower @param {number} upper
   *  @param {number[]} scale the ends of all bars @param {() => void} clicked */
  constructor(name, k, lower, upper, [first, last], clicked) {
    this.lower = lower;
    this.upper = upper;
    this.span = upper - lower || 1;
    this.element = make("li");
    const button = make("button");
    button.type = "button";
    button.dataset.joint = String(k);
    button.addEventListener("click", clicked);
    this.measured = make("i", "measured");
    this.target = make("i", "target");
    this.value = make("span", "value");
    const track = make("span", "track");
    track.append(this.measured, this.target);
    const share = (/** @type {number} */ value) => `${(100 * value) / (last - first || 1)}%`;
    Object.assign(track.style, { marginLeft: share(lower - first), width: share(this.span) });
    track.style.setProperty("--zero", `${(-100 * lower) / this.span}%`);
    const scale = make("span");
    scale.append(track);
    button.append(make("span", "name", name), scale, this.value);
    this.name = name;
    this.element.append(button, ...[-1, 1].map((way) => {
      const jog = make("button", "control", way < 0 ? "−" : "+");
      jog.type = "button";
      Object.assign(jog.dataset, { jog: `joint_${k + 1}`, way });
      jog.title = `Press, while you hold to move: ${name} moves alone`;
      jog.setAttribute("aria-label", `Jog ${name} ${way < 0 ? "minus" : "plus"}`);
      return jog;
    }));
    this.button = button;
  }

  /** @param {number} q @param {number} set @param {string} unit */
  show(q, set, unit) {
    const [scale, digits] = UNITS[unit];
    this.#move(this.measured, q);
    this.#move(this.target, set);
    setText(this.value, signed(scale * q, digits));
    const [lower, upper] = [this.lower, this.upper].map((limit) => (scale * limit).toFixed(digits));
    setAttribute(this.button, "title", `${this.name}: limits ${lower} to ${upper} ${unit}. Click to plot it alone.`);
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

const UNIT_KEY = "hal-console-unit";
const WINDOW = 2; // s over which the servo's rate is counted
const OLD = 500; // ms

/** Measures the rate of a host's ticks. */
class Rate {
  /** ticks/s; null while unknown. @type {number | null} */
  value = null;
  /** @type {[number, number][]} */ #seen = [];

  /** @param {number} t s @param {number} ticks */
  add(t, ticks) {
    const seen = this.#seen;
    if (seen.length && ticks < seen[seen.length - 1][1]) seen.length = 0;
    seen.push([t, ticks]);
    while (t - seen[0][0] > WINDOW) seen.shift();
    const [[t0, first]] = seen;
    this.value = t - t0 > WINDOW / 4 ? (ticks - first) / (t - t0) : null;
  }
}

/** The whole panel. */
export class ArmPanel {
  constructor() {
    this.plot = new Plot();
    /** @type {JointBar[]} */
    this.rows = [];
    this.plot.chosen = () => this.rows.forEach((row, k) => setAttribute(row.button, "aria-pressed", String(k === this.plot.joint)));
    /** @type {any[]} */
    this.robots = [];
    this.name = "";
    /** @type {Map<string, Rate>} */
    this.rates = new Map();
    /** Called with the name of an arm that was clicked. @type {(name: string) => void} */
    this.picked = () => {};
    byId("copy").addEventListener("click", () => this.#copy());
    segments(byId("unit"), Object.keys(UNITS), (unit) => this.#measure(unit));
    this.#measure(remembered(UNIT_KEY) ?? "");
  }

  /** The arm that is shown, of hello. @type {any} */
  #robot = null;
  /** Its newest state; null while it does not answer. @type {any} */
  #state = null;

  /** Copy joints and tcp as a dict that is Python, YAML and JSON alike. */
  #copy() {
    if (!this.#state) return;
    const { q, tcp } = this.#state;
    const [scale, digits] = UNITS[this.unit];
    const joints = q.map((/** @type {number} */ value) => Number((scale * value).toFixed(digits + 2)));
    const name = this.unit === "deg" ? "q_deg" : "q";
    const text = JSON.stringify({ [name]: joints, tcp: { position: tcp.slice(0, 3), orientation: tcp.slice(3) } });
    const field = make("textarea"); // navigator.clipboard needs https
    field.value = text.replace(/[:,]/g, "$& ");
    byId("copy").after(field);
    field.select();
    setText(byId("copy"), document.execCommand("copy") ? "copied" : "not copied");
    field.remove();
    setTimeout(() => setText(byId("copy"), "copy"), 1500);
  }

  /** Show joints in a unit. @param {string} unit */
  #measure(unit) {
    this.unit = unit in UNITS ? unit : "rad";
    remember(UNIT_KEY, this.unit);
    choose(byId("unit"), this.unit);
    [this.plot.scale, this.plot.digits] = UNITS[this.unit];
  }

  /** @param {any[]} robots of hello */
  open(robots) {
    this.robots = robots;
    segments(byId("robots"), robots.map((robot) => robot.name), (name) => this.picked(name));
    const names = robots.map((robot) => robot.name);
    const shown = names.includes(this.name) ? this.name : names[0];
    this.name = "";
    if (shown !== undefined) this.show(shown);
  }

  /** Show this arm. @param {string} name */
  show(name) {
    const robot = this.robots.find((one) => one.name === name);
    if (!robot || name === this.name) return;
    this.name = name;
    this.#robot = robot;
    this.#state = null;
    choose(byId("robots"), name);
    setText(byId("model"), robot.name);
    byId("model").title = `${robot.name}: ${robot.model}, ${robot.driver}, ${robot.real ? "a real arm" : "simulated"}`;
    this.#layOut(robot);
    this.plot.open(robot.joints);
  }

  /** Lay out the bars of an arm's joints. @param {any} robot of hello */
  #layOut(robot) {
    const scale = [Math.min(...robot.lower), Math.max(...robot.upper)];
    this.rows = robot.joints.map((/** @type {string} */ name, /** @type {number} */ k) => {
      const [lower, upper, short] = [robot.lower[k], robot.upper[k], shortened(name, robot.joints)];
      return new JointBar(short, k, lower, upper, scale, () => this.plot.choose(this.plot.joint === k ? null : k));
    });
    byId("joints").replaceChildren(...this.rows.map((row) => row.element));
  }

  /** Add a state to the plot and to the rates. @param {any} state */
  addState(state) {
    const robot = state.robots[this.name];
    this.#state = robot && !robot.lost ? robot : null;
    if (this.#state) {
      const { q, q_set: set, speed, force } = robot;
      const error = Math.max(...q.map((/** @type {number} */ value, /** @type {number} */ k) => Math.abs(value - set[k])));
      this.plot.add(state.t, [...q, error, speed, force ?? NaN], [...set, 0, this.#robot.tcp_speed, 0]);
    }
    for (const [name, host] of Object.entries(state.hosts ?? {})) {
      const rate = this.rates.get(name) ?? new Rate();
      this.rates.set(name, rate);
      rate.add(state.t, host.ticks);
    }
  }

  /** Return how far the gripper is closed, 0..1, or null. @param {any} state */
  closed(state) {
    const gripper = state?.robots[this.name]?.gripper;
    if (!gripper || !this.#robot?.widths || typeof gripper.width !== "number") return null;
    const [least, most] = this.#robot.widths;
    return Math.min(1, Math.max(0, (most - gripper.width) / (most - least)));
  }

  /** Show a state; ten times a second. @param {any} state @param {number} silent ms since it came */
  paint(state, silent) {
    const robot = state.robots[this.name];
    const there = robot && !robot.lost;
    setData(byId("facts"), "old", there && silent < OLD ? null : "");
    if (there) {
      this.rows.forEach((row, k) => row.show(robot.q[k], robot.q_set[k], this.unit));
      const [x, y, z, ...turn] = robot.tcp;
      setText(byId("tcp"), `x ${signed(x, 3)}  y ${signed(y, 3)}  z ${signed(z, 3)} m`);
      const [roll, pitch, yaw] = angles(turn).map((angle) => signed(angle, 1));
      setText(byId("turned"), `${roll}  ${pitch}  ${yaw} °`);
      setText(byId("tcp-speed"), `${signed(robot.speed, 3)} of ${this.#robot.tcp_speed} m/s`);
      setText(byId("force"), robot.force === null ? "not measured" : `${signed(robot.force, 1)} N`);
      setText(byId("width"), gripperText(robot.gripper));
    }
    const known = there && Number.isFinite(silent);
    setText(byId("age"), known ? `${Math.round(1000 * robot.age + silent)} ms old` : (robot?.lost ?? "none"));
    setText(byId("servo"), this.#hosts(state.hosts ?? {}));
    this.plot.paint();
  }

  /** @param {any} hosts */
  #hosts(hosts) {
    const names = Object.keys(hosts);
    return names.map((name) => {
      const host = hosts[name];
      const rate = (this.rates.get(name)?.value ?? host.rate_hz).toFixed(0);
      const silent = host.silent > 0.1 ? `, silent ${host.silent.toFixed(1)} s` : "";
      const called = names.length > 1 ? `${name} ` : "";
      return `${called}${rate} of ${host.rate_hz.toFixed(0)} Hz, ${host.missed} missed${silent}`;
    }).join("\n");
  }
}

/** Return roll, pitch and yaw in degrees. @param {number[]} quaternion x, y, z, w */
function angles([x, y, z, w]) {
  const roll = Math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y));
  const pitch = Math.asin(Math.min(1, Math.max(-1, 2 * (w * y - z * x))));
  const yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
  return [roll, pitch, yaw].map((angle) => (180 * angle) / Math.PI);
}

/** @param {any} gripper of a robot's state */
function gripperText(gripper) {
  if (!gripper) return "none";
  const mm = (/** @type {number} */ width) => (1000 * width).toFixed(1);
  const target = Math.abs(gripper.width - gripper.width_target) > 5e-4 ? ` (target ${mm(gripper.width_target)})` : "";
  const does = gripper.grasped ? ": object gripped" : gripper.moving ? ", moving" : "";
  return `${mm(gripper.width)} mm${target}${does}`;
}
