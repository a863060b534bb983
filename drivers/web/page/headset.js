// The hands of a headset's controllers, or of a phone in AR, as part of the pad (WebXR).
//
// The squeeze (on a phone: a finger on the screen) is the dead-man, the trigger the gripper. The pose of a hand is sent
// with the pad while it holds; the program moves the arm by as much as the hand has moved since the squeeze.

import { byId, setText, show } from "./dom.js";
import { PAD_SILENCE } from "./keys.js";

const [TRIGGER, SQUEEZE, ...STOPS] = [0, 1, 4, 5]; // of the mapping xr-standard; STOPS are A and B, or X and Y
const PRESSED = 0.5; // share of the squeeze's travel from which it holds
const RELEASED = 0.3;
const SILENCE = 1000 * PAD_SILENCE; // ms
/** Time for which the squeezes of an arm are released before one holds, ms: if the program missed a release, it missed
 * more than a dead-man may be silent for, so that the arm has tripped and does not follow a hand that is elsewhere. */
const PAUSE = 1.25 * SILENCE;
const ENTER = "Headset";
const LEAP = 0.1; // m between two pictures, as no hand moves
const DOWN = 0.9; // of a unit vector; steeper counts as looking down
/** Modes of a session, the one that shows what is around first. @type {any[]} */
const MODES = ["immersive-ar", "immersive-vr"];

/** Called `xr` here, for the checker of types knows no WebXR. @type {any} */
const xr = /** @type {any} */ (navigator).xr;

/**
 * Turn a vector of WebXR (x right, y up, z back) into the axes of an arm's base (x forward, y left, z up).
 * @param {any} vector @param {number} [heading] what is forward, rad about the axis up
 */
function toBase({ x, y, z }, heading = 0) {
  const [sine, cosine] = [Math.sin(heading), Math.cos(heading)];
  return [-cosine * z - sine * x, sine * z - cosine * x, y];
}

/** Return what is forward for somebody who looks along -z of an orientation, rad. @param {any} orientation */
function headingOf({ x, y, z, w }) {
  const down = 2 * (y * z - w * x);
  const look = down > DOWN
    ? { x: 2 * (x * y - w * z), y: 0, z: 2 * (y * z + w * x) } // down: forward is what is on top of the picture
    : { x: -2 * (x * z + w * y), y: 0, z: 2 * (x * x + y * y) - 1 };
  const [forward, left] = toBase(look);
  return Math.atan2(left, forward);
}

/** How far a source is squeezed, 0..1. @param {any} source */
const squeezeOf = (source) => source.gamepad?.buttons[SQUEEZE]?.value ?? Number(source.targetRayMode === "screen");

/** What drives one arm: the controller of one hand, or any whose hand has no arm of its own. */
class Hand {
  /** @param {Headset} headset @param {string} side "left", "right" or "any" */
  constructor(headset, side) {
    this.headset = headset;
    this.side = side;
    /** Pose in the axes of an arm's base (x, y, z in m, and a quaternion); empty while it does not hold. */
    this.pose = /** @type {number[]} */ ([]);
  }

  /** The source that holds. @type {any} */ #source = null;
  /** Whether every squeeze was released for long enough, since anything held. */
  #free = false;
  #heldAt = performance.now();
  #heading = 0;
  /** When the pose changed last, ms: a hand that holds still trembles all the same. */
  #movedAt = 0;

  /** How far the trigger is pulled, 0..1. */
  get grip() {
    return this.#source?.gamepad?.buttons[TRIGGER]?.value ?? 0;
  }

  /** Take a picture of the headset. @param {any} frame @param {any[]} sources that may drive this arm */
  take(frame, sources) {
    const squeezed = sources.find((source) => squeezeOf(source) > PRESSED);
    if (sources.some((source) => squeezeOf(source) >= RELEASED)) this.#heldAt = performance.now();
    else this.#free ||= performance.now() - this.#heldAt > PAUSE;
    if (this.#source) this.#follow(frame, sources);
    else if (squeezed && this.#free) this.#engage(frame, squeezed);
  }

  /** Return the pose of a source; null while it is not tracked. @param {any} frame @param {any} source */
  #poseOf(frame, { gripSpace }) {
    const { space } = this.headset;
    const pose = gripSpace ? frame.getPose(gripSpace, space) : frame.getViewerPose(space);
    return pose && !pose.emulatedPosition ? pose.transform : null;
  }

  /** @param {any} frame @param {any} source */
  #engage(frame, source) {
    const viewer = frame.getViewerPose(this.headset.space);
    const pose = this.#poseOf(frame, source);
    if (!viewer || !pose) return;
    this.#source = source;
    this.#heading = headingOf(viewer.transform.orientation);
    this.#move(pose);
  }

  /** @param {any} frame @param {any[]} sources */
  #follow(frame, sources) {
    const source = this.#source;
    if (!sources.includes(source) && source.gamepad) return this.lose("controller disconnected");
    if (!sources.includes(source) || squeezeOf(source) < RELEASED) return this.release();
    const pose = this.#poseOf(frame, source);
    if (!pose) return this.lose("the headset does not see the controller");
    const before = this.pose;
    this.#move(pose);
    const way = Math.hypot(...[0, 1, 2].map((k) => this.pose[k] - before[k]));
    if (!(way <= LEAP)) return this.lose("the tracking leapt");
    if (performance.now() - this.#movedAt > SILENCE) this.lose("the controller does not answer");
  }

  /** @param {any} pose */
  #move({ position, orientation }) {
    const now = [...toBase(position, this.#heading), ...toBase(orientation, this.#heading), orientation.w];
    if (now.some((value, place) => value !== this.pose[place])) this.#movedAt = performance.now();
    this.pose = now;
  }

  /** Let go, and say why, if it holds. @param {string} why */
  lose(why) {
    if (!this.#source) return;
    this.#source.gamepad?.hapticActuators?.[0]?.pulse(1, 200);
    this.release();
    this.headset.tell(`${why}: its controls are released`);
  }

  /** Let go: every squeeze must be released before one holds. */
  release() {
    this.#free = false;
    this.#heldAt = performance.now();
    this.#source = null;
    this.pose = [];
  }
}

export class Headset {
  /**
   * @param {import("./pad.js").Pad} pad @param {import("./deadman.js").Presence} presence
   * @param {() => void} stop @param {(text: string) => void} tell
   */
  constructor(pad, presence, stop, tell) {
    this.pad = pad;
    this.presence = presence;
    this.stop = stop;
    this.tell = tell;
    /** Space of all poses. @type {any} */
    this.space = null;
    /** Called with every picture of the headset. */
    this.shown = () => {};
    pad.released.push(() => this.#update((hand) => hand.release()));
    byId("headset").addEventListener("click", () => (this.#session ? this.#session.end() : this.#start()));
    this.#offer();
  }

  /** @type {any} */ #session = null;
  #mode = "";
  /** @type {Hand[]} */ #hands = [];
  #stopping = false;
  #shownAt = 0; // ms

  /** Use the hands that drive an arm of this rig. @param {string[]} sides */
  open(sides) {
    this.#hands = sides.map((side) => new Hand(this, side));
  }

  async #offer() {
    for (const mode of MODES) {
      if (this.#mode || !(await xr?.isSessionSupported(mode).catch(() => false))) continue;
      this.#mode = mode;
      show(byId("headset"), true);
    }
  }

  async #start() {
    try {
      const session = await xr.requestSession(this.#mode, { requiredFeatures: ["local-floor"] });
      session.addEventListener("end", () => this.#ended());
      session.addEventListener("visibilitychange", () => this.presence.check());
      const gl = document.createElement("canvas").getContext("webgl2", /** @type {any} */ ({ xrCompatible: true }));
      const { XRWebGLLayer } = /** @type {any} */ (window);
      session.updateRenderState({ baseLayer: new XRWebGLLayer(session, gl) }); // without one there are no frames
      this.space = await session.requestReferenceSpace("local-floor");
      this.#session = this.presence.session = session;
      setText(byId("headset"), "Leave headset");
      this.pad.reset();
      this.presence.check();
      session.requestAnimationFrame((/** @type {number} */ _, /** @type {any} */ frame) => this.#take(frame));
    } catch (error) {
      this.tell(`the headset cannot be used: ${error instanceof Error ? error.message : error}`);
    }
  }

  #ended() {
    setText(byId("headset"), ENTER);
    this.#session = this.presence.session = null;
    this.pad.reset();
    this.presence.check();
  }

  /** Let go where the headset shows no pictures any more; before every message. */
  check() {
    if (!this.#session || performance.now() - this.#shownAt <= SILENCE) return;
    this.#update((hand) => hand.lose("the headset hangs"));
  }

  /** Do something with every hand, and take what they do into the pad. @param {(hand: Hand) => void} does */
  #update(does) {
    this.#hands.forEach(does);
    const holding = this.#hands.filter(({ pose }) => pose.length);
    this.pad.hands = Object.fromEntries(holding.map(({ side, pose, grip }) => [side, [...pose, grip]]));
    this.pad.update();
  }

  /** @param {any} frame */
  #take(frame) {
    if (!this.#session) return;
    this.#session.requestAnimationFrame((/** @type {number} */ _, /** @type {any} */ next) => this.#take(next));
    this.#shownAt = performance.now();
    const sources = [...this.#session.inputSources];
    const stopping = sources.some(({ gamepad }) => STOPS.some((place) => gamepad?.buttons[place]?.pressed));
    if (stopping && !this.#stopping) this.stop();
    this.#stopping = stopping;
    this.#update((hand) => hand.take(frame, sources.filter((source) => this.#handOf(source) === hand)));
    this.shown();
  }

  /** @param {any} source */
  #handOf({ handedness }) {
    return [handedness, "any"].map((side) => this.#hands.find((hand) => hand.side === side)).find(Boolean);
  }
}
