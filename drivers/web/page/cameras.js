// What is seen: the 3D view, the pictures of the cameras and the socket that brings them, one large and the others small.

import { socketTo, tokenOfPage } from "./connection.js";
import { byId, choose, make, segments, setData, setText, show } from "./dom.js";
import { DEPTH_COLORS, UNKNOWN_COLOR } from "./keys.js";

const HEADER = 20; // bytes before the JPEG
const RETRY = 1000; // ms until the next try
const DEFAULT = 640; // pixels across, of a picture that is not full
const SMOOTH = /** @type {const} */ ("high");
const JPEG = "image/jpeg";

/** The socket with the pictures. */
class Pictures {
  /** @param {(name: string) => View | undefined} viewOf returns where pictures of this name are shown */
  constructor(viewOf) {
    this.viewOf = viewOf;
    /** @type {string[]} */
    this.cameras = [];
    this.watched = "{}";
  }

  /** @type {WebSocket | null} */ #socket = null;
  #timer = 0;

  /** Connect, or connect again; `cameras`: their names in the rig's order. @param {string[]} cameras */
  open(cameras) {
    this.close();
    this.cameras = cameras;
    const socket = cameras.length ? socketTo("/pictures", tokenOfPage()) : null;
    if (!socket) return;
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.#request();
    socket.onmessage = (event) => this.#take(socket, event.data);
    socket.onclose = () => {
      this.#socket = null;
      this.#timer = setTimeout(() => this.open(cameras), RETRY);
    };
  }

  close() {
    clearTimeout(this.#timer);
    const socket = this.#socket;
    this.#socket = null;
    if (!socket) return;
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
  }

  /** Request the pictures of these cameras only. @param {Record<string, number>} widths of each, device pixels */
  watch(widths) {
    const text = JSON.stringify(widths);
    if (text === this.watched) return;
    this.watched = text;
    this.#request();
  }

  #request() {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(`{"type":"watch","cameras":${this.watched}}`);
  }

  /** @param {WebSocket} socket @param {ArrayBuffer} data */
  async #take(socket, data) {
    if (!(data instanceof ArrayBuffer) || data.byteLength <= HEADER) return;
    const arrived = performance.now();
    const view = new DataView(data);
    const camera = this.cameras[view.getUint8(0)];
    const taken = arrived - 1000 * view.getFloat32(16, true);
    try {
      const size = this.viewOf(camera)?.size;
      const resize = size && { resizeWidth: size[0], resizeHeight: size[1], resizeQuality: SMOOTH };
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, HEADER)], { type: JPEG }), resize ?? {});
      if (socket === this.#socket) this.viewOf(camera)?.draw(bitmap, taken);
      bitmap.close();
    } catch {
      // A broken picture is not shown; the next one may be complete.
    }
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ type: "drawn", camera }));
  }
}

const SILENT = 500; // ms without a new picture after which a camera counts as silent, at least
const PERIODS = 5; // and this many of its own periods
const WINDOW = 2000; // ms over which the rate is counted

/** One camera on the page. */
class View {
  /** @param {any} camera of the rig's list @param {(name: string) => void} enlarge @param {() => void} changed */
  constructor(camera, enlarge, changed) {
    this.camera = camera;
    this.name = camera.name;
    this.patience = Math.max(SILENT, (PERIODS * 1000) / (camera.rate_hz || 30));
    this.figure = make("figure", "camera");
    this.canvas = make("canvas");
    this.canvas.dataset.camera = camera.name;
    this.canvas.width = camera.width;
    this.canvas.height = camera.height;
    this.shape = camera.width / camera.height;
    this.canvas.setAttribute("role", "img");
    this.context = this.canvas.getContext("2d", { alpha: false });
    this.numbers = make("span", "numbers");
    this.old = make("div", "old");
    this.title = make("b");
    this.scale = depthScale(camera.depth);
    this.streams = make("div", "segments");
    this.streams.setAttribute("role", "group");
    this.streams.setAttribute("aria-label", `Picture of camera ${camera.name}`);
    this.streams.addEventListener("click", (/** @type {Event} */ event) => event.stopPropagation());
    const names = Object.keys(camera.streams);
    segments(this.streams, names, (stream) => (this.show(stream), changed()));
    const caption = make("figcaption");
    caption.append(this.title, this.scale, this.numbers);
    this.figure.append(this.canvas, this.old, caption, this.streams);
    this.figure.addEventListener("click", () => enlarge(camera.name));
    this.visible = this.full = false;
    /** Name of the pictures that are shown: those of one stream. */
    this.source = "";
    this.show(names[0]);
  }

  /** @param {string} stream */
  show(stream) {
    this.source = this.camera.streams[stream];
    this.#taken = -Infinity;
    choose(this.streams, stream);
    setText(this.title, this.name + (stream === "color" ? "" : ` (${stream})`));
    show(this.scale, stream === "depth");
    const range = stream === "depth" ? `, ${this.scale.title}` : "";
    this.canvas.setAttribute("aria-label", `Camera ${this.name}, ${stream}${range}`);
    this.mark(performance.now());
  }

  /** When the newest picture was taken, and when the newest ones were drawn, ms. */
  #taken = -Infinity;
  #latency = 0;
  /** @type {number[]} */ #drawn = [];

  /** Device pixels that the picture covers, across and up; null while it is not shown. @returns {number[] | null} */
  get size() {
    const { clientWidth, clientHeight } = this.figure;
    const across = Math.min(clientWidth, clientHeight * this.shape) * devicePixelRatio;
    return across < 1 ? null : [across, across / this.shape].map((one) => Math.max(1, Math.round(one)));
  }

  /** Pixels across to ask for: the camera's, divided by a whole number, so that few sizes are made. */
  get wanted() {
    const across = Math.min(this.size?.[0] ?? DEFAULT, this.full ? Infinity : DEFAULT);
    return Math.floor(this.camera.width / Math.max(1, Math.floor(this.camera.width / across)));
  }

  /** @param {ImageBitmap} bitmap @param {number} taken when it was captured, ms on performance.now() */
  draw(bitmap, taken) {
    if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
      this.canvas.width = bitmap.width;
      this.canvas.height = bitmap.height;
    }
    this.context.drawImage(bitmap, 0, 0);
    const now = performance.now();
    this.#taken = taken;
    this.#latency = now - taken;
    this.#drawn.push(now);
    this.mark(now);
  }

  /** Show how old the picture is; one that is old must not look live. @param {number} now */
  mark(now) {
    while (this.#drawn.length && now - this.#drawn[0] > WINDOW) this.#drawn.shift();
    const age = now - this.#taken;
    const state = age === Infinity ? "none" : age > this.patience ? "stale" : "live";
    setData(this.figure, "state", state);
    if (state === "live") {
      const rate = this.#drawn.length > 1 ? (1000 * (this.#drawn.length - 1)) / (now - this.#drawn[0]) : 0;
      setText(this.numbers, `${rate.toFixed(0)}/s  ${Math.round(this.#latency)} ms`);
    } else {
      const seconds = (age / 1000).toFixed(age < 10000 ? 1 : 0);
      setText(this.numbers, "");
      setText(this.old, state === "none" ? "no picture yet" : `not live: ${seconds} s old`);
    }
  }
}

/** Return the colours of depth with what they mean. @param {number[]} range m */
function depthScale([near, far]) {
  const scale = make("span", "scale");
  const colors = [make("i"), make("i")];
  colors[0].style.background = `linear-gradient(to right, ${DEPTH_COLORS.map((/** @type {number[]} */ one) => `rgb(${one})`)})`;
  colors[1].style.background = `rgb(${UNKNOWN_COLOR})`;
  scale.append(`${near}`, colors[0], `${far} m `, colors[1], "unknown");
  scale.title = `${near} to ${far} m in a logarithmic scale, grey is unknown`;
  return scale;
}

/** Return what draws in 3D in this browser; "" if nothing does. */
function renderer3D() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  return gl ? String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER)) : "";
}

/** Style that leaves viser's drawing only, on the ground of this page: its panel and its warnings would cover it. */
const DRAWING = "body { background: none !important; visibility: hidden } canvas { visibility: visible }";

/** The 3D view, of the rig's own program (drivers/viser). It takes any shape, and opens when it is enlarged. */
class Stage {
  /** @param {(name: string) => void} choose @param {(took: number) => number} pause see Cameras */
  constructor(choose, pause) {
    this.name = "3D";
    this.shape = 0;
    this.visible = false;
    this.figure = make("figure", "camera stage");
    /** Whether the processor would have to draw it: then only a click opens it, for it may starve this page. */
    this.slow = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(renderer3D());
    this.figure.classList.toggle("slow", this.slow);
    const frame = make("iframe");
    this.frame = frame;
    this.opened = false;
    /** Path on this server; every connection of this page has another. */
    this.address = "";
    frame.title = "3D view: hold to move and drag the gizmo on the tool, and the arm follows it";
    frame.tabIndex = -1;
    // The keys stay with this page: a press does not move the focus, and what gets it all the same gives it back.
    const keep = (/** @type {Event} */ event) => event.preventDefault();
    frame.addEventListener("load", () => {
      for (const type of ["mousedown", "contextmenu", "dragstart"]) frame.contentDocument?.addEventListener(type, keep, true);
      if (this.opened) frame.contentDocument?.head.append(make("style", "", DRAWING));
      if (!this.opened || !this.slow) return;
      const view = /** @type {Window} */ (frame.contentWindow), ask = view.requestAnimationFrame.bind(view);
      let drawn = -Infinity, last = 0, took = 0; // all that is drawn at one time is one picture
      view.requestAnimationFrame = (draw) => ask((t) => {
        if (t !== drawn && last === drawn) took = t - drawn;
        last = t;
        if (t !== drawn && t - drawn < pause(took)) view.requestAnimationFrame(draw);
        else draw((drawn = t));
      });
    });
    addEventListener("blur", () => setTimeout(() => document.activeElement === frame && (frame.blur(), focus())));
    const caption = make("figcaption");
    caption.append(make("b", "", this.slow ? "3D (no GPU: still while you hold)" : "3D"));
    this.figure.append(frame, caption);
    this.figure.addEventListener("click", () => choose(this.name)); // while it is small: its frame takes no pointer then
  }

  open() {
    this.opened = true;
    if (this.frame.getAttribute("src") !== this.address) this.frame.src = this.address;
  }

  /** @param {string} address @returns {boolean} whether it closed: drawn without a GPU, it may have cost the connection */
  move(address) {
    const closes = this.opened && this.slow && address !== this.address;
    this.address = address;
    if (closes) {
      this.opened = false;
      this.frame.contentWindow?.location.replace("about:blank");
      this.frame.removeAttribute("src");
    } else if (this.opened) this.open();
    return closes;
  }
}

/** The panel of the 3D view and of all cameras. */
export class Cameras {
  /** @param {(took: number) => number} pause ms from a picture of a 3D view without a GPU to the next; it took so long */
  constructor(pause) {
    this.pause = pause;
    this.pictures = new Pictures((name) => this.views.find((view) => view.source === name));
    /** @type {View[]} */
    this.views = [];
    /** The views, with the 3D view before them if there is one. @type {(View | Stage)[]} */
    this.shown = [];
    /** @type {Stage | null} */
    this.stage = null;
    this.large = "";
    this.alone = false;
    this.seen = new IntersectionObserver((entries) => this.#moved(entries));
    document.addEventListener("visibilitychange", () => this.#watch());
    new ResizeObserver(() => this.#place()).observe(byId("cameras"));
  }

  /** Lay out the panel and connect. @param {any[]} cameras of hello @param {string} stage path of the 3D view, or "" */
  open(cameras, stage) {
    const all = JSON.stringify([stage !== "", cameras]);
    if (this.#built !== all) this.#build(cameras, stage !== "" && renderer3D() !== "");
    this.#built = all;
    if (this.stage?.move(stage)) this.#enlarge(this.shown[this.views.length ? 1 : 0].name, false);
    this.pictures.open(cameras.flatMap((camera) => Object.values(camera.streams)));
  }

  #built = "?";

  /** Ten times a second. */
  paint() {
    const now = performance.now();
    for (const view of this.views) if (view.visible) view.mark(now);
  }

  /** @param {any[]} cameras @param {boolean} staged whether there is a 3D view */
  #build(cameras, staged) {
    this.seen.disconnect();
    const enlarge = (/** @type {string} */ name) => this.#enlarge(name, true);
    this.views = cameras.map((camera) => new View(camera, enlarge, () => this.#watch()));
    this.stage = staged ? new Stage(enlarge, this.pause) : null;
    this.shown = this.stage ? [this.stage, ...this.views] : this.views;
    byId("cameras").replaceChildren(...this.shown.map((view) => view.figure));
    const names = this.shown.map((view) => view.name);
    segments(byId("tabs"), names, enlarge);
    if (names.length) this.#enlarge(names[this.stage?.slow && this.views.length ? 1 : 0], !this.stage?.slow);
    else byId("cameras").append(make("p", "hint", "This rig has no cameras."));
    for (const view of this.views) this.seen.observe(view.figure);
    show(byId("tabs"), names.length > 1);
  }

  /** Make a view large; once more: alone, and in all its pixels. @param {string} name @param {boolean} clicked not at first */
  #enlarge(name, clicked) {
    const alone = clicked && name === this.large && !this.alone;
    this.large = name;
    this.alone = alone;
    if (clicked && name === this.stage?.name) this.stage.open();
    for (const view of this.shown) {
      view.figure.classList.toggle("large", view.name === name);
      show(view.figure, !alone || view.name === name);
    }
    for (const view of this.views) view.full = alone && view.name === name;
    choose(byId("tabs"), name);
    this.#place();
  }

  /** Fill the panel: the other pictures below the large one or beside it, whichever shows them larger. */
  #place() {
    const { clientWidth: width, clientHeight: height } = byId("cameras");
    const large = this.shown.find((view) => view.name === this.large);
    if (!large || !width || !height) return;
    const others = this.shown.filter((view) => view !== large && getComputedStyle(view.figure).display !== "none");
    const share = others.length ? MOST : 1;
    const shapeOf = (/** @type {View | Stage} */ view) => view.shape || (view === large ? width / (share * height) : 4 / 3);
    const below = stacked(width, height, large, others, shapeOf);
    const beside = stacked(height, width, large, others, (view) => 1 / shapeOf(view)).map(turned);
    const area = (/** @type {number[][]} */ boxes) => boxes.reduce((sum, [, , w, h]) => sum + w * h, 0);
    const boxes = area(below) >= area(beside) ? below : beside;
    [large, ...others].forEach(({ figure }, k) => {
      const [left, top, w, h] = boxes[k];
      Object.assign(figure.style, { left: `${left}px`, top: `${top}px`, width: `${w}px`, height: `${h}px` });
    });
    this.#watch();
  }

  /** @param {IntersectionObserverEntry[]} entries */
  #moved(entries) {
    for (const entry of entries) {
      const view = this.views.find((one) => one.figure === entry.target);
      if (view) view.visible = entry.isIntersecting;
    }
    this.#watch();
  }

  #watch() {
    const visible = document.visibilityState === "visible";
    const seen = this.views.filter((view) => visible && view.visible);
    this.pictures.watch(Object.fromEntries(seen.map((view) => [view.source, view.wanted])));
  }
}

const GAP = 10; // px
const MOST = 0.7; // share of the panel that the large picture may take from the others

/** @param {number[]} box */
const turned = ([left, top, width, height]) => [top, left, height, width];

/**
 * Boxes (left, top, width, height) of a large picture and of a row of others below it.
 * @param {number} width @param {number} height @param {View | Stage} large @param {(View | Stage)[]} others
 * @param {(view: View | Stage) => number} shapeOf width by height
 */
function stacked(width, height, large, others, shapeOf) {
  const room = others.length ? MOST * height : height;
  const first = Math.min(room, width / shapeOf(large));
  const gaps = GAP * (others.length - 1);
  const all = others.reduce((sum, view) => sum + shapeOf(view), 0);
  const row = others.length ? Math.min(height - GAP - first, (width - gaps) / all) : 0;
  const top = Math.max(0, (height - first - (row && GAP + row)) / 2);
  const boxes = [[(width - first * shapeOf(large)) / 2, top, first * shapeOf(large), first]];
  let left = (width - gaps - row * all) / 2;
  for (const view of others) {
    boxes.push([left, top + first + GAP, row * shapeOf(view), row]);
    left += row * shapeOf(view) + GAP;
  }
  return boxes;
}
