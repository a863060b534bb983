// Light or dark: as the system has it, until a person chooses.

import { byId } from "./dom.js";

const KEY = "hal-console-theme";

/** @returns {string | null} */
function remembered() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // a browser may forbid it
  }
}

/** @param {string} theme */
function remember(theme) {
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // Then it holds for as long as the page is open.
  }
}

/** Wire the toggle. @param {() => void} changed */
export function openTheme(changed) {
  const root = document.documentElement;
  const known = remembered();
  if (known === "light" || known === "dark") {
    root.dataset.theme = known;
    changed(); // what was drawn before has the other one's colours
  }
  byId("theme").addEventListener("click", () => {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const now = root.dataset.theme ?? (dark ? "dark" : "light");
    root.dataset.theme = now === "dark" ? "light" : "dark";
    remember(root.dataset.theme);
    changed();
  });
}
