// The plot of the last seconds: target and measured joint positions, all below each other, or one joint or MORE large.

import { byId, choose, segments, setText } from "./dom.js";

/** Return a joint's name without the beginning that all of them share. @param {string} name @param {string[]} all */
export function shortened(name, all) {
  let same = all.length > 1 ? name.length : 0;
  for (const other of all) while (!other.startsWith(name.slice(0, same))) same -= 1;
  while (same > 0 && /\d/.test(name[same - 1])) same -= 1; // never cut a number in two
  const rest = name.slice(same);
  return /^\d/.test(rest) ? `J${rest}` : rest;
}

/** Format a number so that its sign always takes the same room. @param {number} value @param {number} digits */
export function signed(value, digits) {
  if (typeof value !== "number") return "–";
  const text = Math.abs(value).toFixed(digits);
  return (value < 0 && Number(text) !== 0 ? "−" : "\u2007") + text;
}

/** What else is plotted: name, heading, what its dashed line is, digits; the first one is in the unit of the joints. */
const MORE = [
  ["error", "largest following error of a joint", "zero", 4],
  ["speed", "tcp speed, m/s", "limit", 2],
  ["force", "force on the tool, N", "zero", 1],
];

const SPAN = 20; // s
const CAPACITY = 512; // samples; 20 a second come
const GAP = 0.3; // s between two samples above which no line joins them
const SMALLEST = 0.02; // rad; a smaller range is not enlarged to the full height

/** Ring of samples and the canvas that shows it. */
export class Plot {
  constructor() {
    this.canvas = byId("plot");
    this.context = this.canvas.getContext("2d");
    /** @type {string[]} */
    this.names = [];
    /** The only thing to plot: a joint, or one of MORE, which follow them; null: all joints. @type {number | null} */
    this.joint = null;
    /** Called when that changes. */
    this.chosen = () => {};
    const more = MORE.map(([name]) => String(name));
    segments(byId("plots"), ["joints", ...more], (name) => {
      this.choose(name === "joints" ? null : this.names.length + more.indexOf(name));
    });
    this.visible = true;
    /** Of the unit in which positions are shown: its share of a radian, and digits. */
    [this.scale, this.digits] = [1, 3];
    const seen = new IntersectionObserver((entries) => (this.visible = entries[entries.length - 1].isIntersecting));
    seen.observe(this.canvas);
    new ResizeObserver(() => this.#resize()).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.restyle());
    this.restyle();
  }

  #times = new Float64Array(CAPACITY);
  /** @type {Float32Array[]} */ #q = [];
  /** @type {Float32Array[]} */ #set = [];
  #count = 0;
  #ratio = 1;
  #colours = { measured: "", target: "", quiet: "" };
  #font = "";

  /** Clear the plot for these joints. @param {string[]} names */
  open(names) {
    this.names = names.map((name) => shortened(name, names));
    [this.#q, this.#set] = [0, 1].map(() => [...names, ...MORE].map(() => new Float32Array(CAPACITY)));
    this.#count = 0;
    this.choose(null);
  }

  /** @param {number | null} joint null: all of them */
  choose(joint) {
    this.joint = joint;
    const more = joint === null ? undefined : MORE[joint - this.names.length];
    setText(byId("plotted"), String(more ? more[1] : joint === null ? "all joints" : this.names[joint]));
    setText(byId("dashed"), String(more ? more[2] : "target"));
    choose(byId("plots"), String(more ? more[0] : "joints"));
    this.chosen();
    this.paint();
  }

  /** @param {number} t s @param {number[]} q @param {number[]} set of the joints, rad, and of MORE */
  add(t, q, set) {
    const last = (this.#count - 1) % CAPACITY;
    if (this.#count && t <= this.#times[last]) {
      if (t === this.#times[last]) return;
      this.#count = 0; // another clock: the program was started again
    }
    const place = this.#count % CAPACITY;
    this.#times[place] = t;
    this.#q.forEach((series, k) => (series[place] = q[k]));
    this.#set.forEach((series, k) => (series[place] = set[k]));
    this.#count += 1;
  }

  /** Read the colours of the present theme. */
  restyle() {
    const panel = byId("plotting");
    const colour = (/** @type {string} */ part) => getComputedStyle(panel.querySelector(part)).color;
    this.#colours = { measured: colour(".measured"), target: colour(".target"), quiet: colour(".keys") };
    this.#font = `12px ${getComputedStyle(document.body).fontFamily}`;
  }

  #resize() {
    this.#ratio = devicePixelRatio || 1;
    this.canvas.width = Math.round(this.canvas.clientWidth * this.#ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * this.#ratio);
    this.paint();
  }

  paint() {
    const { context, canvas } = this;
    const [width, height] = [canvas.width / this.#ratio, canvas.height / this.#ratio];
    if (!this.visible || width < 40 || height < 20) return;
    context.setTransform(this.#ratio, 0, 0, this.#ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    context.font = this.#font;
    context.textBaseline = "middle";
    const shown = this.joint === null ? this.names.map((_, k) => k) : [this.joint];
    const floor = height - 14;
    const strip = floor / shown.length;
    shown.forEach((joint, k) => this.#strip(joint, k * strip, strip, width));
    this.#ruler(floor, width);
  }

  /** Yield the places of the samples in view, the oldest first. */
  *#places() {
    const newest = this.#times[(this.#count - 1) % CAPACITY];
    for (let k = Math.max(0, this.#count - CAPACITY); k < this.#count; k += 1) {
      const place = k % CAPACITY;
      if (this.#times[place] >= newest - SPAN) yield place;
    }
  }

  /** @param {number} joint @param {number} top @param {number} height @param {number} width */
  #strip(joint, top, height, width) {
    const { context } = this;
    const alone = this.joint !== null;
    const left = alone ? 46 : 26;
    const [q, set] = [this.#q[joint], this.#set[joint]];
    let [low, high] = [Infinity, -Infinity];
    for (const place of this.#places()) {
      low = Math.min(low, q[place], set[place]);
      high = Math.max(high, q[place], set[place]);
    }
    const middle = (low + high) / 2;
    const half = Math.max(joint < this.names.length ? SMALLEST : SMALLEST / 10, high - low) / 2;
    const pad = alone ? 8 : 3;
    const y = (/** @type {number} */ value) => top + height / 2 - ((value - middle) / half) * (height / 2 - pad);
    context.fillStyle = context.strokeStyle = this.#colours.quiet;
    context.textAlign = "left";
    if (!alone) context.fillText(this.names[joint], 0, top + height / 2, left - 4);
    context.lineWidth = 1;
    context.globalAlpha = 0.25;
    context.strokeRect(left + 0.5, Math.round(top) + 0.5, width - left - 1, Math.round(height) - 1);
    context.globalAlpha = 1;
    if (!(high >= low)) return;
    if (alone) this.#scale(middle, half, left, y);
    this.#line(set, left, width, y, this.#colours.target, alone ? 2.5 : 2, [4, 3]);
    this.#line(q, left, width, y, this.#colours.measured, 1.5, []);
  }

  /** @param {number} middle @param {number} half @param {number} left @param {(value: number) => number} y */
  #scale(middle, half, left, y) {
    const { context } = this;
    context.textAlign = "right";
    const more = Number(this.joint) - this.names.length;
    const [scale, digits] = [more > 0 ? 1 : this.scale, more < 0 ? this.digits : Number(MORE[more][3])];
    for (const value of [middle - half, middle, middle + half]) {
      context.fillText(signed(scale * value, digits), left - 5, y(value));
    }
  }

  /**
   * @param {Float32Array} series @param {number} left @param {number} width @param {(value: number) => number} y
   * @param {string} colour @param {number} thick @param {number[]} dash
   */
  #line(series, left, width, y, colour, thick, dash) {
    const { context } = this;
    const newest = this.#times[(this.#count - 1) % CAPACITY];
    let before = -Infinity;
    context.beginPath();
    for (const place of this.#places()) {
      const t = this.#times[place];
      const x = width - 1 - ((newest - t) / SPAN) * (width - left - 2);
      if (t - before > GAP) context.moveTo(x, y(series[place]));
      else context.lineTo(x, y(series[place]));
      before = t;
    }
    context.strokeStyle = colour;
    context.lineWidth = thick;
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  /** @param {number} floor @param {number} width */
  #ruler(floor, width) {
    const left = this.joint === null ? 26 : 46;
    this.context.fillStyle = this.#colours.quiet;
    for (const seconds of [SPAN, SPAN / 2, 0]) {
      this.context.textAlign = seconds === SPAN ? "left" : seconds ? "center" : "right";
      const x = width - (seconds / SPAN) * (width - left);
      this.context.fillText(seconds ? `−${seconds} s` : "now", x, floor + 8);
    }
  }
}
