// The socket with the cameras' pictures.

import { socketTo, tokenOfPage } from "./connection.js";

const HEADER = 20; // bytes before the JPEG
const AGAIN = 1000; // ms until the next try
const SMOOTH = /** @type {const} */ ("high");
const JPEG = "image/jpeg";

/**
 * @typedef {object} Picture
 * @property {number} camera place in the rig's list
 * @property {ImageBitmap} bitmap
 * @property {number} taken when it was captured, ms on performance.now()
 */

export class Pictures {
  constructor() {
    /** Draw it now; the bitmap is closed afterwards. @type {(picture: Picture) => void} */
    this.came = () => {};
    /** Device pixels, across and up, at which a camera is shown; null: unknown. @type {(camera: number) => number[] | null} */
    this.sizeOf = () => null;
    /** @type {string[]} */
    this.cameras = [];
    /** @type {string[]} */
    this.watched = [];
  }

  /** @type {WebSocket | null} */ #socket = null;
  #timer = 0;

  /** Connect, or connect anew; `cameras`: their names in the rig's order. @param {string[]} cameras */
  open(cameras) {
    this.close();
    this.cameras = cameras;
    const socket = cameras.length ? socketTo("/pictures", tokenOfPage()) : null;
    if (!socket) return;
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => this.#tell();
    socket.onmessage = (event) => this.#take(socket, event.data);
    socket.onclose = () => {
      this.#socket = null;
      this.#timer = setTimeout(() => this.open(cameras), AGAIN);
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

  /** Ask for the pictures of these cameras only. @param {string[]} names */
  watch(names) {
    this.watched = names;
    this.#tell();
  }

  #tell() {
    if (this.#socket?.readyState === WebSocket.OPEN) {
      this.#socket.send(JSON.stringify({ type: "watch", cameras: this.watched }));
    }
  }

  /** @param {WebSocket} socket @param {ArrayBuffer} data */
  async #take(socket, data) {
    if (!(data instanceof ArrayBuffer) || data.byteLength <= HEADER) return;
    const arrived = performance.now();
    const view = new DataView(data);
    const camera = view.getUint8(0);
    const taken = arrived - 1000 * view.getFloat32(16, true);
    try {
      const size = this.sizeOf(camera);
      const resize = size && { resizeWidth: size[0], resizeHeight: size[1], resizeQuality: SMOOTH };
      const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, HEADER)], { type: JPEG }), resize ?? {});
      if (socket === this.#socket) this.came({ camera, bitmap, taken });
      bitmap.close();
    } catch {
      // A broken picture is not shown, and grows old on the page; the next one may be whole.
    }
    if (socket.readyState === WebSocket.OPEN && camera < this.cameras.length) {
      socket.send(JSON.stringify({ type: "drawn", camera: this.cameras[camera] }));
    }
  }
}
