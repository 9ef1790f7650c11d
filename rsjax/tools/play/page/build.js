// Builds what the server's welcome describes, once.
import { makeBranches } from "./branches.js";
import { compareBranch, dropBranch, fork, openBranch } from "./session.js";
import { askAgain, askLate, layout, meter, redraw, watched } from "./drawing.js";
import { keepsKey, makeStick } from "./drive.js";
import { makeKeep } from "./keep.js";
import { makeView } from "./panes.js";
import { makeChart } from "./player/chart.js";
import { element } from "./player/dom.js";
import { at, attempt, ready, state } from "./state.js";
import { turbo } from "./turbo.js";
import { keep, makeChecks, makeSampling, makeSources, showKeys } from "./ui.js";

const FAR = [0.1, 10]; // metres, of runs without depth
const KEYS = {
  KeyB: () => fork(state.frame),
  KeyC: () => at("open-clips").click(),
  Digit1: () => state.parts.toggle("depth"),
  Digit2: () => state.parts.toggle("truth"),
  Digit3: () => state.parts.toggle("points"),
  Digit4: () => state.parts.toggle("uncertainty"),
  Digit5: () => state.parts.toggle("smooth"),
};

/** Builds the parts. */
export function build() {
  const { run, controls, sources, limits, settings, truth } = state.welcome;
  const { connection, transport, shows } = state;
  document.title = `rsjax · play · ${run.name}`;
  at("run").textContent = `${run.name} · ${run.image_size} × ${run.image_size} · ${run.device}`;
  at("measured").textContent = trust(run.measured);
  const view = (title, kinds) => makeView({ title, kinds, size: run.image_size, depthRange: run.depth_range ?? FAR });
  const set = (fields) => attempt(connection.call("settings", fields));
  const facing = run.source?.startsWith("robosuite/");
  const seek = (frame) => (transport.pause(), transport.go(frame));
  state.parts = {
    dream: view("dream", ["rgb", "depth"]),
    truth: view("simulator", ["truth", "truth_depth"]),
    beside: view("branch beside", ["rgb", "depth"]),
    stick: makeStick({ controls, facing, host: at("controls"), switches: at("toggles"), pad: at("pad"), changed: touched }),
    sources: makeSources({ host: at("source"), sources, clips: run.clips, changed: sourceChanged }),
    sampling: makeSampling({ host: at("sampling"), limits, settings, changed: set }),
    branches: makeBranches({ host: at("branches"), open: openBranch, compare: compareBranch, drop: dropBranch }),
    chart: makeChart({ title: "PSNR against the simulator", unit: "dB", seek }),
    shown: [],
  };
  const rows = [
    ["depth", "depth", "1", run.has_depth ? "" : "the run has none"],
    ["truth", "simulator", "2", truth],
    ["points", "keypoints", "3", ""],
    ["uncertainty", "uncertainty", "4", ""],
    ["smooth", "smooth pictures", "5", ""],
  ];
  state.parts.toggle = makeChecks({ host: at("views"), states: shows, changed: viewChanged, rows });
  makeKeep({ host: at("keep"), call: connection.call, fps: run.fps, view: shownNow });
  at("transport").append(transport.controls);
  at("chart").append(state.parts.chart.host);
  if (run.has_depth) at("depth-scale").append(...scale(run.depth_range));
  showKeys(at("key-list"), keyList(state.parts.stick.keys));
  listen();
}

/** Says how far the model can be trusted, from scores of the run's evaluation; "" without any. */
function trust(measured) {
  const { contact_false_success: lied, contact_false_failure: lost, contact_brier: brier } = measured;
  const off = measured.drive_gripper_error_widths;
  const lines = [];
  if (lied !== undefined) lines.push(`of the grasps that fail in the simulator, ${(100 * lied).toFixed(0)} % succeed here`);
  if (lost !== undefined) lines.push(`of those that succeed there, ${(100 * lost).toFixed(0)} % fail here`);
  if (brier !== undefined) lines.push(`the Brier score of grasps is ${brier.toFixed(2)} (a guess of one half has 0.25)`);
  if (off !== undefined) lines.push(`after 48 frames of free driving the gripper is ${off.toFixed(1)} cube widths astray`);
  return lines.length ? `How far to trust it: ${lines.join("; ")}.` : "";
}

function listen() {
  const { stick } = state.parts;
  setInterval(meter, 500);
  setInterval(measureTrip, 5000);
  setInterval(askLate, 2000);
  document.addEventListener("rsjax-forget", () => state.pace.clear()); // of measurements (tests/tools/play/latency.py)
  document.addEventListener("keydown", typed);
  document.addEventListener("keyup", stick.key);
  document.addEventListener("visibilitychange", () => ready() && state.pace.pump());
  addEventListener("blur", () => stick.rest());
  addEventListener("gamepadconnected", () => requestAnimationFrame(pollGamepad));
  at("rest").addEventListener("click", () => stick.rest());
  at("branch-here").addEventListener("click", () => fork(state.frame));
}

function shownNow() {
  const { current, beside, shows, session } = state;
  return { branch: current, beside, truth: shows.truth && session.has_truth, depth: shows.depth && session.has_depth };
}

function scale([near, far]) {
  const bar = element("i", {});
  const colors = Array.from({ length: 12 }, (_, place) => `rgb(${turbo(place / 11)})`);
  bar.style.background = `linear-gradient(to right, ${colors.join(", ")})`;
  return [element("span", {}, `${near.toPrecision(3)} m`), bar, element("span", {}, `${far.toPrecision(3)} m`)];
}

function viewChanged(name) {
  keep("view", state.shows);
  askAgain();
  if (name !== "smooth") attempt(state.connection.call("watch", { kinds: watched() }));
  layout();
  redraw();
}

function sourceChanged(name) {
  state.halted = false;
  at("controls").classList.toggle("idle", name !== "stick");
}

/** Sends a step where the stick has left its rest; time is that of the key, button or finger. */
function touched(time) {
  state.halted = false;
  if (!state.parts || !state.session || state.parts.sources.name() !== "stick") return;
  if (state.parts.stick.driving() || state.transport.playing()) state.pace.touch(time);
}

function pollGamepad() {
  if (state.parts.stick.poll()) requestAnimationFrame(pollGamepad);
}

async function measureTrip() {
  if (document.hidden || state.pace.flying()) return;
  const sent = performance.now();
  const answer = await state.connection.call("ping").catch(() => null);
  if (answer) state.pace.setTrip(performance.now() - sent);
}

function keyList(stick) {
  return [
    ...stick,
    [["Shift"], "with these: gently"],
    [["X"], "all sliders to rest"],
    [["Space"], "play: frames that there are, then new ones"],
    [["←", "→"], "a frame back and on; at the end a new one"],
    [["Home", "End"], "the first and the last frame"],
    [["<", ">"], "slower, faster"],
    [["B"], "branch here"],
    [["C"], "start from another clip or a picture"],
    [["1", "…", "5"], "depth, simulator, keypoints, uncertainty, smooth pictures"],
    [["gamepad"], "left stick: the first two; right stick: the third and the last turn; first button: gripper"],
  ];
}

function typed(event) {
  if (!state.session || keepsKey(event)) return;
  const plain = !event.ctrlKey && !event.metaKey && !event.altKey && !event.repeat;
  if (event.key === "?") at("open-keys").click();
  else if (state.parts.stick.key(event)) event.preventDefault();
  else if (plain && KEYS[event.code]) KEYS[event.code]();
  else if (state.transport.key(event)) event.preventDefault();
}
