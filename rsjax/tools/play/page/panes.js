// The pictures: RGB with its overlays, and depth below it.
import { element } from "./player/dom.js";
import { depthColors } from "./turbo.js";

const OVERLAY = 384; // pixels of an overlay's side
const POINTS = 1.8; // pixels of a point's radius
const SURE = "255 200 0"; // colour of uncertain cells

/**
 * Makes the panes of one view.
 * @param kinds the kinds of its two pictures, such as ["rgb", "depth"].
 */
export function makeView({ title, kinds, size, depthRange }) {
  const [picture, depth] = kinds.map((kind) => makePicture(`${title}: ${kind.endsWith("depth") ? "depth" : "picture"}`, size));
  const caption = element("span", { class: "pane-title" }, title);
  const note = element("span", { class: "pane-note" });
  const overlay = element("canvas", { class: "overlay", width: OVERLAY, height: OVERLAY, "aria-hidden": "true" });
  const figure = element(
    "figure",
    { class: "view" },
    element("figcaption", {}, caption, note),
    element("div", { class: "layers" }, picture.canvas, overlay),
    element("div", { class: "depth-picture" }, depth.canvas),
  );
  let token = 0;

  /** Draws a frame of a branch; resolves when its RGB is drawn (false: another was asked for meanwhile). */
  async function draw(tree, branch, frame, shown) {
    const mine = ++token;
    const rgb = tree.frame(branch, kinds[0], frame);
    figure.classList.toggle("empty", !rgb);
    if (!rgb) return false;
    const bitmap = await bitmapOf(rgb);
    if (mine !== token) return false;
    picture.context.drawImage(bitmap, 0, 0, size, size);
    bitmap.close();
    drawOverlay(tree, branch, frame, shown);
    drawDepth(tree.frame(branch, kinds[1], frame), mine);
    return true;
  }

  async function drawDepth(grey, mine) {
    depth.canvas.classList.toggle("stale", !grey);
    if (!grey) return;
    const bitmap = await bitmapOf(grey);
    if (mine !== token) return;
    depth.context.drawImage(bitmap, 0, 0, size, size);
    bitmap.close();
    const image = depth.context.getImageData(0, 0, size, size);
    const colors = depthColors(...depthRange, grey.scale || depthRange[1]);
    for (let at = 0; at < image.data.length; at += 4) image.data.set(colors[image.data[at]], at);
    depth.context.putImageData(image, 0, 0);
  }

  function drawOverlay(tree, branch, frame, { points, uncertainty }) {
    const context = overlay.getContext("2d");
    context.clearRect(0, 0, OVERLAY, OVERLAY);
    const entropy = uncertainty && kinds[0] === "rgb" && tree.frame(branch, "uncertainty", frame);
    if (entropy) drawCells(context, entropy);
    const pane = kinds[0] === "rgb" ? "rgb" : "truth";
    if (points) drawPoints(context, tree.pointsAt(branch, pane, frame) ?? []);
  }

  return { figure, draw, caption, note };
}

function makePicture(label, size) {
  const canvas = element("canvas", { width: size, height: size, role: "img", "aria-label": label });
  return { canvas, context: canvas.getContext("2d", { willReadFrequently: label.endsWith("depth") }) };
}

function bitmapOf(frame) {
  return createImageBitmap(frame.data, { colorSpaceConversion: "none" });
}

function drawCells(context, { data, width, height }) {
  for (let row = 0; row < height; row++) {
    for (let column = 0; column < width; column++) {
      context.fillStyle = `rgb(${SURE} / ${((0.75 * data[row * width + column]) / 255).toFixed(2)})`;
      context.fillRect((column * OVERLAY) / width, (row * OVERLAY) / height, OVERLAY / width, OVERLAY / height);
    }
  }
}

function drawPoints(context, points) {
  for (const [x, y, visible] of points) {
    context.beginPath();
    context.arc(x * OVERLAY, y * OVERLAY, visible ? 2 * POINTS : POINTS, 0, 2 * Math.PI);
    context.fillStyle = visible ? "#ffffff" : "#00000055";
    context.strokeStyle = "#1060c0";
    context.lineWidth = 1.5;
    context.fill();
    context.stroke();
  }
}
