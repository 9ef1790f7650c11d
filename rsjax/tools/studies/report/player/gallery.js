// The report's player: the videos of a clip side by side, in step.
import { makeChart } from "./chart.js";
import { element, takesKeys } from "./dom.js";
import { makeTransport } from "./transport.js";

const SMALL = 128; // pixels of a side below which pixels are shown as squares

/** Makes the player of clips (rsjax/tools/studies/report/player.py says what each holds) inside an element. */
function makeGallery(host, { clips, rate }) {
  let clip = null;
  let cells = [];
  const pictures = element("div", { class: "cells" });
  const title = element("p", { class: "clip-title" });
  const scale = element("div", { class: "depth-scale" });
  const smooth = element("input", { type: "checkbox", onchange: render });
  const transport = makeTransport({ count: 1, rate, show, name });
  const chart = makeChart({ title: "PSNR, frame by frame", unit: "dB", seek });
  const choices = clips.map((each) =>
    element("button", { type: "button", class: "choice", onclick: () => open(each) }, element("span", {}, each.label)),
  );
  const about = element("div", { class: "about" }, title, scale);
  const stage = element("div", { class: "stage" }, pictures, transport.controls, about);
  const list = element("div", { class: "choices", role: "group", "aria-label": "clips" }, ...choices);
  const side = element("div", { class: "side-panel" }, element("h3", {}, "Clips"), list, chart.host);
  const keys = element("p", { class: "keys" }, "Keys: ", key("space"), " plays, ", key("←"), " ", key("→"), " step, ");
  keys.append(key("<"), " ", key(">"), " change the speed, ", key("↑"), " ", key("↓"), " choose the clip. ");
  side.append(element("label", { class: "check" }, smooth, " smooth pictures"), keys);
  host.append(stage, side);
  host.addEventListener("keydown", onkey);
  choices.forEach((choice, place) => loadImages(clips[place]).then(() => choice.prepend(thumbnail(clips[place]))));
  open(clips[0]).then(() => matchMedia("(prefers-reduced-motion: reduce)").matches || transport.play());

  function name(frame, total) {
    return `frame ${frame + 1} of ${total}${clip && frame < clip.prompt ? ", prompt" : ""}`;
  }

  function key(text) {
    return element("kbd", {}, text);
  }

  async function open(chosen) {
    clip = chosen;
    choices.forEach((choice, place) => choice.setAttribute("aria-pressed", clips[place] === chosen));
    await loadImages(chosen);
    if (clip !== chosen) return;
    cells = chosen.rows.map((row) => makeCell(chosen, row));
    pictures.replaceChildren(...cells.map(({ figure }) => figure));
    title.textContent = chosen.title;
    scale.replaceChildren(...(chosen.depth ? depthScale(chosen.depth) : []));
    smooth.checked = Math.max(...chosen.size) > SMALL;
    render();
    transport.resize(chosen.frames);
  }

  function render() {
    pictures.classList.toggle("smooth", smooth.checked);
  }

  function show(frame) {
    if (!clip) return;
    const [height, width] = clip.size;
    for (const { context, image } of cells) {
      const columns = image.naturalWidth / width;
      const [left, top] = [(frame % columns) * width, Math.floor(frame / columns) * height];
      context.drawImage(image, left, top, width, height, 0, 0, width, height);
    }
    chart.draw(clip.psnr, frame, clip.frames);
  }

  function seek(frame) {
    transport.pause();
    transport.go(frame);
  }

  function onkey(event) {
    const place = clips.indexOf(clip) + ({ ArrowUp: -1, ArrowDown: 1 }[event.key] ?? 0);
    const button = event.target.closest("button") && [" ", "Enter"].includes(event.key);
    if (takesKeys(event.target) || button) return;
    if (clips[place] && clips[place] !== clip) {
      open(clips[place]);
      choices[place].focus({ preventScroll: true });
    } else if (!event.key.startsWith("Arrow") && !transport.key(event)) return;
    else if (event.key.startsWith("Arrow")) transport.key(event);
    event.preventDefault();
  }
}

/** Loads a clip's videos, once. */
function loadImages(clip) {
  clip.loading ??= Promise.all(
    clip.rows.map(async (row) => {
      row.image = new Image();
      row.image.src = row.uri;
      await row.image.decode();
    }),
  );
  return clip.loading;
}

function makeCell(clip, row) {
  const [height, width] = clip.size;
  const canvas = element("canvas", { width, height, role: "img", "aria-label": row.label });
  const figure = element("figure", {}, element("figcaption", {}, row.label), canvas);
  figure.style.setProperty("--narrow", row.narrow);
  return { figure, image: row.image, context: canvas.getContext("2d") };
}

/** Draws the last predicted frame, small. */
function thumbnail(clip) {
  const [height, width] = clip.size;
  const canvas = element("canvas", { width, height, "aria-hidden": "true" });
  const columns = clip.rows[0].image.naturalWidth / width;
  const last = clip.frames - 1;
  const [left, top] = [(last % columns) * width, Math.floor(last / columns) * height];
  canvas.getContext("2d").drawImage(clip.rows[0].image, left, top, width, height, 0, 0, width, height);
  return canvas;
}

function depthScale({ near, far, colors }) {
  const bar = element("i", {});
  bar.style.background = `linear-gradient(to right, ${colors.join(", ")})`;
  return [element("span", {}, `depth: ${near}`), bar, element("span", {}, far)];
}

for (const data of document.querySelectorAll("script.gallery-data")) {
  makeGallery(document.getElementById(data.dataset.host), JSON.parse(data.textContent));
}
