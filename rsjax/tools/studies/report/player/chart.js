// Draws lines over frames with a cursor, and lists their values there.
import { drawing, element } from "./dom.js";

const HEIGHT = 150;
const LEFT = 30;
const BOTTOM = 20;
const TOP = 8;
const RIGHT = 8;

/**
 * Makes a chart.
 * @param seek called with a frame when the chart is pressed there; null: it only shows.
 * @returns its element, and draw(series, frame, count): series are {name, values}; null and missing values are gaps.
 */
export function makeChart({ title, unit, seek = null, digits = 1 }) {
  const plot = drawing("svg", { role: "img", class: "plot", height: HEIGHT });
  const legend = element("ul", { class: "legend" });
  const host = element("figure", { class: "chart" }, element("figcaption", {}, title), plot, legend);
  let drawn = null;

  function draw(series, frame, count) {
    drawn = [series, frame, count];
    const width = Math.max(160, plot.clientWidth || 260);
    const known = series.flatMap(({ values }) => values).filter(Number.isFinite);
    const [low, high, ticks] = range(known);
    const x = (at) => LEFT + (at / Math.max(1, count - 1)) * (width - LEFT - RIGHT);
    const y = (value) => TOP + ((high - value) / (high - low)) * (HEIGHT - TOP - BOTTOM);
    plot.setAttribute("viewBox", `0 0 ${width} ${HEIGHT}`);
    plot.replaceChildren(
      ...ticks.flatMap((tick) => [
        drawing("line", { class: "grid", x1: LEFT, x2: width - RIGHT, y1: y(tick), y2: y(tick) }),
        drawing("text", { x: LEFT - 6, y: y(tick) + 4, "text-anchor": "end" }, `${tick}`),
      ]),
      drawing("text", { x: LEFT, y: HEIGHT - 4 }, "1"),
      drawing("text", { x: width - RIGHT, y: HEIGHT - 4, "text-anchor": "end" }, `frame ${count}`),
      ...series.flatMap(({ values }, place) => line(values, place, x, y)),
      drawing("line", { class: "cursor", x1: x(frame), x2: x(frame), y1: TOP, y2: HEIGHT - BOTTOM }),
    );
    const texts = series.map(({ name, values }) => [name, value(values[frame])]);
    plot.setAttribute("aria-label", `${title}; ${texts.map((pair) => pair.join(": ")).join(", ")}`);
    legend.replaceChildren(
      ...texts.map(([name, text], place) =>
        element("li", {}, element("i", { class: `key series-${place}` }), element("span", {}, name), element("b", {}, text)),
      ),
    );
  }

  function value(at) {
    return Number.isFinite(at) ? `${at.toFixed(digits)} ${unit}` : "–";
  }

  function press(event) {
    if (!drawn || (event.type === "pointermove" && !event.buttons)) return;
    const box = plot.getBoundingClientRect();
    const share = (event.clientX - box.left - LEFT) / Math.max(1, box.width - LEFT - RIGHT);
    seek(Math.round(Math.max(0, Math.min(1, share)) * (drawn[2] - 1)));
  }

  if (seek) {
    plot.classList.add("seeks");
    plot.addEventListener("pointerdown", press);
    plot.addEventListener("pointermove", press);
  }
  new ResizeObserver(() => drawn && draw(...drawn)).observe(host);
  return { host, draw };
}

function line(values, place, x, y) {
  let path = "";
  values.forEach((value, at) => {
    if (!Number.isFinite(value)) return;
    path += `${Number.isFinite(values[at - 1]) ? "L" : "M"}${x(at).toFixed(1)} ${y(value).toFixed(1)}`;
  });
  return path ? [drawing("path", { class: `line series-${place}`, d: path })] : [];
}

/** Returns the least and greatest value of the axis, and its ticks: round numbers, at most five. */
function range(values) {
  if (!values.length) return [0, 1, []];
  const [least, most] = [Math.min(...values), Math.max(...values)];
  const step = [0.5, 1, 2, 5, 10, 20, 50, 100].find((each) => (most - least) / each <= 3.5) ?? 100;
  const low = Math.floor(least / step) * step;
  const high = Math.max(Math.ceil(most / step) * step, low + step);
  const ticks = [];
  for (let tick = low; tick <= high + 1e-9; tick += step) ticks.push(tick);
  return [low, high, ticks];
}
