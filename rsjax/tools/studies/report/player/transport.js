// Plays numbered frames: play and pause, step, a slider, the rate, and keys.
import { element, icon, iconButton } from "./dom.js";

const RATES = [1, 2, 4, 8, 16].map((rate) => [rate, `${rate} frame${rate > 1 ? "s" : ""}/s`]);
const FASTEST = 16; // frames a second at which existing frames are shown again

function counted(frame, total) {
  return `frame ${frame + 1} of ${total}`;
}

/**
 * Makes the controls over frames 0 … count-1.
 * @param show called with the number of the frame to show.
 * @param choices the rates, each with its text.
 * @param beyond called where a step leads past the last frame; without it, playing starts over there.
 * @param changed called when playing starts or stops.
 * @returns the controls' element, and functions that move, play, pause and change the number of frames.
 */
export function makeTransport({ count, rate, show, name = counted, choices = RATES, beyond = null, changed = null }) {
  let frame = 0;
  let playing = false;
  let last = 0;
  const slider = element("input", { type: "range", min: 0, step: 1, value: 0, "aria-label": "frame" });
  const counter = element("output", { class: "counter" });
  const toggle = iconButton("play", "play (space)", () => (playing ? pause() : play()));
  const rates = element("select", { "aria-label": "speed" });
  for (const [value, text] of choices) rates.append(element("option", { value, selected: value === rate }, text));
  const controls = element(
    "div",
    { class: "transport" },
    iconButton("back", "one frame back (←)", () => step(-1)),
    toggle,
    iconButton("forward", "one frame on (→)", () => step(1)),
    slider,
    counter,
    rates,
  );
  slider.addEventListener("input", () => {
    pause();
    go(Number(slider.value));
  });

  function go(to) {
    frame = Math.max(0, Math.min(count - 1, to));
    slider.max = Math.max(0, count - 1);
    slider.value = frame;
    slider.setAttribute("aria-valuetext", name(frame, count));
    counter.textContent = name(frame, count);
    show(frame);
  }

  function step(by) {
    pause();
    if (beyond && frame + by >= count) beyond();
    else go(frame + by);
  }

  function play() {
    playing = true;
    last = performance.now();
    label();
    requestAnimationFrame(tick);
  }

  function pause() {
    playing = false;
    label();
  }

  function label() {
    const text = playing ? "pause (space)" : "play (space)";
    toggle.replaceChildren(icon(playing ? "pause" : "play"));
    toggle.setAttribute("aria-label", text);
    toggle.title = text;
    changed?.(playing);
  }

  // The last frame of a loop stays four times longer.
  function tick(now) {
    if (!playing) return;
    const end = frame === count - 1;
    const wait = (1000 / Math.min(FASTEST, Number(rates.value))) * (end ? 4 : 1);
    if (now - last >= wait && !(beyond && end)) {
      last = now - last > 2 * wait ? now : last + wait;
      go((frame + 1) % count);
    }
    requestAnimationFrame(tick);
  }

  /** Acts on a key; returns whether it was one of the controls'. */
  function key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    const act = {
      " ": () => (playing ? pause() : play()),
      ArrowLeft: () => step(-1),
      ArrowRight: () => step(1),
      Home: () => step(-frame),
      End: () => step(count - 1 - frame),
      "<": () => faster(-1),
      ">": () => faster(1),
    }[event.key];
    if (!act) return false;
    act();
    return true;
  }

  function faster(by) {
    rates.selectedIndex = Math.max(0, Math.min(rates.length - 1, rates.selectedIndex + by));
  }

  function resize(total, at = frame) {
    count = total;
    go(at);
  }

  return { controls, go, play, pause, key, resize, frame: () => frame, playing: () => playing, rate: () => Number(rates.value) };
}
