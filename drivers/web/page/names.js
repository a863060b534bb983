// The pad's controls by name, in the order in which they travel, and the keys that stand for them.

/** Sticks and d-pad are -1..1 (right and up positive), l2 and r2 are 0..1. */
export const AXES = ["left_x", "left_y", "right_x", "right_y", "l2", "r2", "dpad_x", "dpad_y"];

/** Bit k of a mask is button k. */
export const BUTTONS = [
  "south", "east", "west", "north", "l1", "r1", "l2", "r2", "select", "start", "l3", "r3", "home", "touchpad",
];

/** Name of an axis -> its place. */
export const AXIS = Object.fromEntries(AXES.map((name, place) => [name, place]));

/** Name of a button -> its bit, as a number with only that bit set. */
export const BIT = Object.fromEntries(BUTTONS.map((name, place) => [name, 1 << place]));

/** What a button may do that moves nothing: it steers a recording. */
export const ACTIONS = ["record", "finish", "fail", "discard"];

/** Name of a disc -> its two axes, across and up. */
export const DISCS = { dpad: ["dpad_x", "dpad_y"], left: ["left_x", "left_y"], right: ["right_x", "right_y"] };

/** KeyboardEvent.code -> the axis that it pushes, and which way. @type {Record<string, [string, number]>} */
export const AXIS_KEYS = {
  ArrowUp: ["dpad_y", 1], ArrowDown: ["dpad_y", -1], ArrowRight: ["dpad_x", 1], ArrowLeft: ["dpad_x", -1],
  KeyW: ["left_y", 1], KeyS: ["left_y", -1], KeyD: ["left_x", 1], KeyA: ["left_x", -1],
  KeyI: ["right_y", 1], KeyK: ["right_y", -1], KeyL: ["right_x", 1], KeyJ: ["right_x", -1],
};

/** KeyboardEvent.code -> the button that it is. */
export const BUTTON_KEYS = {
  PageUp: "l1", KeyQ: "l1", PageDown: "r1", KeyE: "r1",
  Digit1: "south", Digit2: "east", Digit3: "west", Digit4: "north", Enter: "start",
  Digit0: "home", // far from the keys that drive
};

export const HOLD_KEY = "Space";
export const HOME_KEY = "Home";
export const GRIP_KEYS = { KeyG: 1, KeyH: -1 };
export const SLOW_KEYS = ["ShiftLeft", "ShiftRight"];
export const STOP_KEYS = ["Escape", "Backspace"];

/** How far keys push while a slow key is held. */
export const SLOWER = 0.3;

/** Rows of the legend: keys, and the controls that they stand for. */
export const LEGEND = [
  ["↑ ↓", "dpad_y"], ["← →", "dpad_x"], ["Q / Page Up", "l1"], ["E / Page Down", "r1"],
  ["W S", "left_y"], ["A D", "left_x"], ["I K", "right_y"], ["J L", "right_x"], ["G H", "r2"],
  ["1", "south"], ["2", "east"], ["3", "west"], ["4", "north"], ["Enter", "start"],
  ["0", "home"],
];
