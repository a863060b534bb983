// What covers the page while there is no connection: nothing on it is live then.

import { ENDED, REFUSED, TOO_MANY } from "./connection.js";
import { byId, setText, show } from "./dom.js";

/** Close code -> what it means, and what to do. @type {Record<number, [string, string]>} */
const ENDINGS = {
  [REFUSED]: [
    "this link is not valid",
    "Use the newest link in the terminal.",
  ],
  [TOO_MANY]: ["too many pages are open", "Close one of the others, then try again."],
  [ENDED]: [
    "the program has ended",
    "Start it again and open the new link that it prints.",
  ],
};

export class Overlay {
  /** @param {() => void} again */
  constructor(again) {
    byId("again").addEventListener("click", again);
  }

  hide() {
    show(byId("overlay"), false);
  }

  /**
   * @param {number} code the socket's close code @param {string} reason
   * @param {number | null} retry ms until the next try
   * @param {{drove: boolean, watched: boolean, real: boolean, saved: number | null}} before what this page did until
   *   now; `saved`: episodes of a recording that was done
   */
  show(code, reason, retry, { drove, watched, real, saved }) {
    const lost = [lostTitle(drove, watched), lostText(drove, watched, real)];
    const [title, text] = saved === null ? ENDINGS[code] ?? lost : finished(saved, real && code !== ENDED);
    setText(byId("overlay-title"), title);
    setText(byId("overlay-text"), text);
    const told = code >= 4400 && !(code in ENDINGS) && reason ? `The program closed it: ${reason}. ` : "";
    setText(byId("overlay-next"), told + (retry === null || saved !== null ? "" : "Reconnecting..."));
    show(byId("again"), code === TOO_MANY);
    show(byId("overlay"), true);
  }
}

/**
 * A recording was done when the program went away.
 * @param {number} saved episodes @param {boolean} doubtful might a real arm be driven still?
 */
function finished(saved, doubtful) {
  const own = doubtful ? " Use the robot's own stop if the arm moves." : "";
  return [
    `the program has finished: ${saved} episode${saved === 1 ? "" : "s"} saved`,
    `Start it again and open the new link that it prints.${own}`,
  ];
}

/** @param {boolean} drove @param {boolean} watched */
function lostTitle(drove, watched) {
  if (drove) return "connection lost: the arm has been stopped";
  return watched ? "connection lost: nothing here is live" : "no connection to the program";
}

/** @param {boolean} drove @param {boolean} watched @param {boolean} real */
function lostText(drove, watched, real) {
  const own = real ? " Use the robot's own stop if it moves." : "";
  if (drove) return `The arm stops when the connection is lost.${own}`;
  if (watched) return `STOP does not reach the arm from here.${own}`;
  return "Is it still running, and is this the newest link in the terminal?";
}
