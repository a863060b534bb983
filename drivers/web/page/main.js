// Start of the console's page: makes the parts and passes messages between them.

import { ArmPanel } from "./arm.js";
import { Cameras } from "./cameras.js";
import { Connection, Overlay } from "./connection.js";
import { Lease, Settings } from "./control.js";
import { Controls } from "./controls.js";
import { Heartbeat, Presence, ReleaseWatch } from "./deadman.js";
import { byId, openTheme, setAttribute, setData, setText, show } from "./dom.js";
import { BrowserGamepad } from "./gamepad.js";
import { Headset } from "./headset.js";
import { Keyboard } from "./keyboard.js";
import { PAD_SILENCE } from "./keys.js";
import { Pad } from "./pad.js";
import { Recording } from "./recording.js";
import { Log, Status, Stopping } from "./status.js";

const REPAINT = 100; // ms
const COARSE = matchMedia("(hover: none) and (pointer: coarse)"); // fingers, and no keyboard

const connection = new Connection();
const pad = new Pad();
const presence = new Presence();
const lease = new Lease(connection);
const heartbeat = new Heartbeat(pad, connection, () => lease.mine && connection.connected && presence.check());
const log = new Log();
const status = new Status(connection, lease);
const panel = new ArmPanel();
// Each picture of the 3D view stalls this page: a press must be possible in between.
const cameras = new Cameras((took) => (pad.held ? Infinity : lease.mine ? Math.max(2000, 10 * took) : 0));
const recording = new Recording(connection, lease);
const settings = new Settings(connection, lease, panel, () => pad.held, (text) => status.notice(text));
const overlay = new Overlay(() => connection.open());
const mayDrive = () => lease.mine && presence.present;
const controls = new Controls(pad, mayDrive);
const stopping = new Stopping(connection, log);
const stop = () => stopping.stop();
const keyboard = new Keyboard(pad, mayDrive, stop);
const releases = new ReleaseWatch(pad, keyboard);
const gamepad = new BrowserGamepad(pad, (text) => log.add(text));
const headset = new Headset(pad, presence, stop, (text) => {
  log.add(text);
  status.notice(text);
});

/** @type {any} */
let hello = null;
/** @type {any} */
let state = null;
let stateAt = -Infinity;
let shown = false;

const silence = () => performance.now() - stateAt;
const isReal = () => hello !== null && (!hello.rig.sim || hello.rig.robots.some((/** @type {any} */ one) => one.real));

/** Return a rig's name: that of its file. @param {string} source */
const rigName = (source) => source.replace(/^.*[/\\]/, "").replace(/\.ya?ml$/, "");

/** Message type -> its handler. @type {Record<string, (message: any) => void>} */
const HANDLERS = {
  hello(message) {
    hello = message;
    const { rig } = hello;
    log.clear();
    setText(byId("rig"), rigName(rig.source));
    byId("rig").title = rig.source;
    setText(byId("kind"), rig.emulated ? "EMULATED ARM" : isReal() ? "REAL ARM" : "SIMULATION");
    show(byId("kind"), true);
    setData(document.documentElement, "real", isReal() ? "" : null);
    setData(document.documentElement, "connected", "");
    show(byId("demo"), rig.demo);
    gamepad.mayHold = rig.pad_may_hold;
    headset.open(rig.hands);
    controls.paint();
    status.waiting = [];
    status.forget();
    lease.hello(hello);
    recording.forget();
    panel.open(rig.robots);
    settings.open(rig);
    cameras.open(rig.cameras, rig.stage && `${rig.stage}/${hello.page}/`);
    gamepad.describe();
  },
  lease(message) {
    log.synchronise(message.t);
    lease.heard(message);
    recording.paint();
    paintSettings();
    retitle();
    advise();
  },
  labels(message) {
    controls.explain(message);
    recording.explain(message);
    settings.explain(message);
    paintSettings();
  },
  driving(message) {
    settings.heard(message);
    paintSettings();
  },
  recording(message) {
    recording.heard(message);
    retitle();
  },
  beat(message) {
    heartbeat.answered(message.t);
  },
  state(message) {
    state = message;
    stateAt = performance.now();
    stopping.addState(state);
    connection.proved();
    show(byId("overlay"), false);
    log.synchronise(state.t);
    recording.setTime(state.t);
    panel.addState(state);
    if (state.late > PAD_SILENCE) status.note("late", 1000 * state.late);
    status.show(state.robots, settings.robot || panel.name, 0);
    setText(byId("demo"), state.playing ? "End tour" : "Play tour");
    advise();
  },
  pad(message) {
    status.waiting = message.waiting;
    if (status.waiting.includes("r2")) controls.releaseGrip();
    advise();
  },
  say(message) {
    status.addMessage(message, log.add(message.text, message.t));
  },
  refused(message) {
    log.add(message.why);
    status.notice(message.why);
  },
};

function paintSettings() {
  settings.paint();
  lease.paint();
}

function advise() {
  status.advise(presence.present, pad.held, pad.pushed, state?.playing ?? false);
  if (controls.mustRelease !== status.mustRelease) {
    controls.mustRelease = status.mustRelease;
    controls.paint();
  }
}

function retitle() {
  const title = `${recording.title}${lease.mine ? "driving " : ""}${hello ? rigName(hello.rig.source) : "console"}`;
  if (document.title !== title) document.title = title;
  setAttribute(byId("demo"), "aria-disabled", String(!lease.mine));
  byId("demo").title = lease.mine ? "" : "Only the page in control can do that";
}

connection.heard = (message) => HANDLERS[message.type]?.(message);

connection.lost = (code, reason, retry) => {
  const watched = document.documentElement.dataset.connected !== undefined;
  if (watched || code >= 4400 || !shown) { // a failed retry must not hide that the arm was stopped
    overlay.show(code, reason, retry, { drove: lease.mine, watched, real: isReal(), saved: recording.outcome });
  }
  shown = true;
  show(byId("notice"), false); // it was for the connection that is gone
  setData(document.documentElement, "connected", null);
  stateAt = -Infinity;
  lease.disconnected();
  recording.forget();
  cameras.pictures.close();
  retitle();
};

controls.holdKeys = () => (gamepad.holds ? `Space or ${pad.deadman.toUpperCase()}` : "Space");
status.holdName = () => (COARSE.matches ? "the button" : gamepad.holds ? pad.deadman.toUpperCase() : "Space");

lease.granted = (t) => {
  pad.reset();
  heartbeat.granted(t);
};
lease.ended = () => pad.reset();
lease.taken = (why) => status.notice(`${why}: press "Take control" to get it back`);

presence.left = (why) => {
  if (lease.mine) heartbeat.leave(why);
  pad.reset();
  advise();
};
presence.came = () => {
  pad.reset();
  advise();
};

releases.lost = (why) => {
  log.add(why);
  heartbeat.leave("hands");
  pad.reset();
};

heartbeat.before.push((dt) => releases.check(dt), (dt) => keyboard.moveGrip(dt), () => gamepad.read(), () => headset.check());
headset.shown = () => heartbeat.pump();
heartbeat.stalled = (ms) => {
  log.add("this computer is too busy: the page hung");
  status.note("hang", ms);
};
heartbeat.slow = (ms) => status.note("slow", ms);
pad.changed.push(() => advise());

// A finger on STOP counts at once; a click without a pointer comes from the keyboard or an assistive tool.
byId("stop").addEventListener("pointerdown", stop);
byId("stop").addEventListener("click", (/** @type {MouseEvent} */ event) => event.detail === 0 && stop());
byId("demo").addEventListener("click", () => {
  if (lease.mine) connection.send({ type: "demo", play: !state?.playing });
});
// A click does not move the focus, or Enter, which is the pad's start, would click the button once more.
addEventListener("mousedown", (event) => {
  if (!(event.target instanceof Element) || !event.target.closest("button, summary")) return;
  event.preventDefault();
  if (document.activeElement instanceof HTMLElement) document.activeElement.blur();
});
addEventListener("hashchange", () => { // another link: the browser loads nothing when only its token differs
  lease.linkOpened();
  connection.open();
});

/** Show the connection to the program and its round trip. */
function paintLink() {
  const roundTrip = lease.mine && heartbeat.roundTrip !== null ? ` ${heartbeat.roundTrip.toFixed(0)} ms` : "";
  const alive = connection.connected && silence() < 500;
  setText(byId("link"), alive ? `connected${roundTrip}` : connection.connected ? "no data" : "not connected");
  setData(byId("link-lamp"), "tone", alive ? "on" : "alarm");
}

setInterval(() => {
  paintLink();
  cameras.paint();
  recording.paint();
  if (!state) return;
  const pages = state.pages;
  setText(byId("pages"), `${pages} page${pages === 1 ? "" : "s"}`);
  status.show(state.robots, settings.robot || panel.name, silence());
  advise();
  controls.slider.mark(panel.closed(state));
  panel.paint(state, silence());
}, REPAINT);

byId("legend").open = matchMedia("(min-width: 1100px) and (min-height: 1000px)").matches;
openTheme(() => panel.plot.restyle());
heartbeat.start();
connection.open();

/** The state of the page, for tests. */
Object.defineProperty(window, "halConsole", {
  value: Object.freeze({
    get connected() { return connection.connected; },
    get driving() { return lease.mine; },
    get lastState() { return state; },
    get beats() { return heartbeat.beats; },
    get page() { return hello?.page ?? null; },
    get recording() { return recording.view; },
  }),
});
