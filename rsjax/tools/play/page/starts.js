// The dialog of first frames: held-out clips, and a picture of one's own.
import { address } from "./connection.js";
import { element } from "./player/dom.js";

const PAGE = 48; // clips asked for at once

/**
 * Makes the dialog.
 * @param start called with the fields of a start message.
 * @param upload sends a file; returns the promise of its answer.
 */
export function makeStarts({ start, upload, note }) {
  const dialog = document.getElementById("clips");
  const list = document.getElementById("clip-list");
  const more = document.getElementById("more-clips");
  const seed = document.getElementById("seed");
  const file = document.getElementById("upload");
  let shown = 0;
  let last = { clip: 0 };

  async function load() {
    const answer = await fetch(address("/api/clips", { first: String(shown), count: String(PAGE) }));
    const { clips, total, message } = await answer.json();
    if (!answer.ok) throw new Error(message);
    list.append(...clips.map(card));
    shown += PAGE; // damaged clips are left out
    more.hidden = shown >= total;
  }

  function card({ clip, task, frames, success }) {
    const image = element("img", { src: address(`/api/clip/${clip}.webp`), alt: "", loading: "lazy" });
    const result = success === null || success === undefined ? "" : success ? ", success" : ", failure";
    const text = element("span", {}, `clip ${clip}`, element("small", {}, `${task}, ${frames} frames${result}`));
    return element("button", { type: "button", class: "clip", onclick: () => begin({ clip }) }, image, text);
  }

  function begin(fields) {
    last = fields;
    dialog.close();
    start({ ...fields, ...(seed.value === "" ? {} : { seed: Number(seed.value) }) });
  }

  async function take() {
    const [chosen] = file.files;
    file.value = "";
    if (!chosen) return;
    try {
      const { message } = await upload(chosen);
      begin({ upload: true });
      note(message);
    } catch (error) {
      note(error.message, true);
    }
  }

  function open() {
    dialog.showModal();
    if (!shown) load().catch((error) => note(error.message, true));
  }

  more.addEventListener("click", () => load().catch((error) => note(error.message, true)));
  file.addEventListener("change", take);
  document.getElementById("restart").addEventListener("click", () => begin(last));
  document.getElementById("open-clips").addEventListener("click", open);
  /** Shows what a session began from. */
  function taken({ seed: number, start: from }) {
    seed.value = number;
    last = from.clip === undefined ? { upload: true } : { clip: from.clip };
  }

  return { open, taken, last: () => last };
}
