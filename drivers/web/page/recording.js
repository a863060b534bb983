// The panel of a program that records demonstrations: its progress, and the buttons that steer it.

import { byId, make, onTap, setAttribute, setData, setText, show } from "./dom.js";
import { KEYS } from "./keys.js";

const OLD = 10; // s; a program that records sends views more often

/** Phase -> tone of its lamp. @type {Record<string, string>} */
const TONES = { ready: "on", recording: "record" };

/** What is listed -> its text. @type {Record<string, (view: any) => string>} */
const FACTS = {
  episode: ({ saved, wanted }) => (wanted ? `${Math.min(saved + 1, wanted)} of ${wanted}` : String(saved + 1)),
  length: ({ seconds }) => `${seconds.toFixed(1)} s`,
  rows: ({ frames }) => String(frames),
  dropped: ({ dropped }) => String(dropped),
  succeeded: ({ succeeded }) => String(succeeded),
  failed: ({ failed }) => String(failed),
  discarded: ({ discarded }) => String(discarded),
  free: ({ free_bytes: bytes }) => `${(bytes / 1e9).toFixed(1)} GB`,
};

/** Set a text that may be cut off, with the whole of it as a tooltip. @param {HTMLElement} element @param {string} text */
function setLongText(element, text) {
  setText(element, text);
  if (element.title !== text) element.title = text;
}

/** The panel; hidden until the program shows a recording. */
export class Recording {
  /** @param {import("./connection.js").Connection} connection @param {import("./control.js").Lease} lease */
  constructor(connection, lease) {
    this.connection = connection;
    this.lease = lease;
    /** Newest view of the program; null: it records nothing. @type {any} */
    this.view = null;
    /** @type {HTMLElement[]} */
    this.buttons = [...byId("recording").querySelectorAll("[data-action]")];
    for (const button of this.buttons) onTap(button, () => this.#request(button.dataset.action));
    for (const name of Object.keys(FACTS)) {
      const row = make("div");
      row.append(make("dt", "", name === "free" ? "disk free" : name), make("dd"));
      row.lastChild.id = `recording-${name}`;
      byId("recording").lastElementChild.append(row);
    }
  }

  /** s since the newest view. */
  #age = 0;

  /** Beginning of the page's title; empty while nothing is recorded. */
  get title() {
    return this.view?.phase === "recording" ? `REC ${Math.floor(this.view.seconds)} s ` : "";
  }

  /** Number of saved episodes if the program is done, else null. @type {number | null} */
  get outcome() {
    return this.view?.phase === "done" ? this.view.saved : null;
  }

  /** Show a new view of the program. @param {any} view */
  heard(view) {
    this.view = view;
    this.#age = 0;
    this.paint();
  }

  /** Note the time of the app's clock. @param {number} t s */
  setTime(t) {
    if (this.view) this.#age = t - this.view.t;
  }

  /** Hide the panel: another program may record nothing. */
  forget() {
    this.view = null;
    this.paint();
  }

  /** Label every button with the button of the pad, and the key, that do the same. @param {any} labels */
  explain({ controls }) {
    for (const button of this.buttons) {
      const same = Object.keys(controls).find((name) => controls[name].join() === button.dataset.action);
      const key = KEYS.legend.find(([, control]) => control === same)?.[0];
      const note = /** @type {Element} */ (button.querySelector("small"));
      setText(/** @type {Element} */ (note.querySelector("span")), same ?? "");
      setText(/** @type {Element} */ (note.querySelector("kbd")), key ?? "");
      if (key) setAttribute(button, "aria-keyshortcuts", key);
      else button.removeAttribute("aria-keyshortcuts");
    }
  }

  /** @param {string | undefined} action */
  #request(action) {
    if (this.#may(action)) this.connection.send({ type: "action", action });
  }

  /** @param {string | undefined} action */
  #may(action) {
    return this.lease.mine && this.view !== null && this.view.actions.includes(action);
  }

  /** Show the view; also when control changes, and ten times a second. */
  paint() {
    const { view } = this;
    show(byId("recording"), view !== null);
    setData(document.documentElement, "recording", view?.phase ?? null);
    this.#sign(view);
    if (!view) return;
    const { phase, prompt, task, trouble, saved, wanted } = view;
    const lost = this.#lost(view);
    setText(byId("recording-phase"), lost ? `no update for ${Math.floor(this.#age)} s` : phase);
    setData(byId("recording-lamp"), "tone", lost || trouble ? "alarm" : TONES[phase] ?? "calm");
    setLongText(byId("recording-prompt"), prompt);
    setLongText(byId("recording-task"), task);
    setText(byId("recording-number"), `dataset episode ${view.episode}`);
    const progress = byId("recording-progress");
    show(progress, wanted > 0);
    setAttribute(progress, "max", String(Math.max(1, wanted)));
    setAttribute(progress, "value", String(saved));
    setText(byId("recording-saved"), wanted ? `${saved} of ${wanted} saved` : `${saved} saved`);
    for (const [name, words] of Object.entries(FACTS)) setText(byId(`recording-${name}`), words(view));
    setData(byId("recording-dropped"), "tone", view.dropped > 0 ? "alarm" : null);
    setLongText(byId("recording-trouble").firstElementChild, trouble);
    show(byId("recording-trouble"), trouble !== "");
    this.#paintButtons();
  }

  /** Whether the program sent no view for too long while it records: the episode may be lost. @param {any} view */
  #lost(view) {
    return view.phase === "recording" && this.#age > OLD;
  }

  /** Show the sign in the header, which is in view wherever the panel is. @param {any} view */
  #sign(view) {
    const records = view?.phase === "recording";
    show(byId("rec-lamp"), view !== null); // it keeps its place, so that nothing moves when it lights up
    setData(byId("rec-lamp"), "tone", !records ? null : view.trouble || this.#lost(view) ? "alarm" : "record");
    setText(byId("rec"), records ? `REC ${view.seconds.toFixed(1)} s` : "");
  }

  #paintButtons() {
    const why = this.lease.mine ? "" : "Only the page in control can do that";
    show(byId("recording-actions"), Boolean(this.lease.rig?.drivable));
    for (const button of this.buttons) {
      setAttribute(button, "aria-disabled", String(!this.#may(button.dataset.action)));
      if (button.title !== why) button.title = why;
    }
  }
}
