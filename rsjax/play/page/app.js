// The page: what is shown, and what each message and key does.
import { makeBranches } from "./branches.js";
import { connect } from "./connection.js";
import { keepsKey, makeStick } from "./drive.js";
import { makeKeep } from "./keep.js";
import { makePace } from "./pace.js";
import { makeView } from "./panes.js";
import { makeChart } from "./player/chart.js";
import { element } from "./player/dom.js";
import { makeTransport } from "./player/transport.js";
import { makeStarts } from "./starts.js";
import { makeTree } from "./tree.js";
import { turbo } from "./turbo.js";
import { keep, kept, makeBanner, makeChecks, makeNotes, makeSampling, makeSources, showKeys, useTheme } from "./ui.js";

const BLOCK = 32; // frames asked for at once
const FAST = 1000; // frames a second: as fast as it goes
const CLOSED = {
  4401: "The token is missing or wrong: open the address that the server printed.",
  4403: "The server refuses this address: open the one that it printed.",
  4408: "This session was freed, since nothing happened for a while.",
  4409: "This session was opened in another window.",
  4429: "The server is full.",
  1008: "The server closed the connection: too many messages.",
};
const at = (id) => document.getElementById(id);
const note = makeNotes(at("notes"));
const banner = makeBanner(at("banner"));
const tree = makeTree();
const shows = kept("view", { depth: true, truth: true, points: false, uncertainty: false, smooth: false });

let welcome = null;
let session = null; // the last `session` message
let current = 0; // the branch that is driven
let beside = null; // the branch shown beside it
let frame = 0;
let forking = false;
let halted = false; // after a step that failed, until the next key
let parts = null; // what the welcome describes: stick, sources, views …
let dirty = false;
const asked = new Set();
const pending = []; // frames to be drawn whose time is measured: [frame, time of the key or null]

const transport = makeTransport({
  count: 1,
  rate: FAST,
  choices: [[1, "1 frame/s"], [2, "2 frames/s"], [5, "5 frames/s"], [10, "10 frames/s"], [FAST, "full speed"]],
  name: (number, total) => `frame ${number + 1} of ${total}`,
  show: moved,
  beyond: () => pace.step(),
  changed: () => ready() && pace.pump(),
});
const pace = makePace({ wants, send, rate: () => transport.rate(), failed });
const chart = makeChart({ title: "PSNR against the simulator", unit: "dB", seek: (number) => (transport.pause(), transport.go(number)) });
const branches = makeBranches({ host: at("branches"), open: openBranch, compare: showBeside, drop: dropBranch });
const connection = connect({
  session: () => sessionStorage.getItem("rsjax-session"),
  on: { open: greeted, message: received, frame: gotFrame, lost, closed },
});
const starts = makeStarts({ start, upload: connection.upload, note });

function ready() {
  return parts !== null && session !== null && !forking;
}

// ---- the connection

function greeted(message) {
  const again = welcome !== null;
  welcome = message;
  sessionStorage.setItem("rsjax-session", message.session);
  banner.hide();
  health("connected", "");
  pace.reset();
  asked.clear();
  if (!again) build();
  watch();
  if (message.returned) return; // its session follows
  if (again) note("The server knows this session no more: it starts again.", true);
  if (location.hash.startsWith("#state=")) loadLink();
  else start(starts.last());
}

function received(message) {
  if (message.type === "session") applySession(message);
  else if (message.type === "truth") {
    tree.putScore(message);
    redraw();
  } else if (message.type === "points") {
    tree.putPoints(message);
    redraw();
  } else if (message.type === "truth_off") note(message.message, true);
  else if (message.type === "status") health(message.text, message.busy ? "busy" : "");
  else if (message.type === "progress") health(`${message.what} ${message.done} of ${message.total}`, message.done < message.total ? "busy" : "");
  else if (message.type === "error") note(message.message, true);
}

function health(text, state) {
  at("health").dataset.state = state;
  const shown = at("health").lastElementChild;
  const words = text || "connected";
  if (shown.textContent !== words) shown.textContent = words;
}

function lost(wait) {
  transport.pause();
  pace.reset();
  health("not connected", "lost");
  banner.show(`The connection was lost. Trying again in ${Math.ceil(wait / 1000)} s.`, "Try now", () => connection.again());
}

function closed(code, reason) {
  transport.pause();
  pace.reset();
  health("not connected", "lost");
  if (code !== 4429) sessionStorage.removeItem("rsjax-session");
  const text = code === 4429 && reason ? reason : CLOSED[code];
  banner.show(text, code === 4408 ? "Start again" : "Try again", () => connection.again());
}

async function attempt(promise) {
  try {
    return await promise;
  } catch (error) {
    if (error.code !== "lost") note(error.message, true);
    return null;
  }
}

// ---- a session

async function start(fields) {
  transport.pause();
  const message = await attempt(connection.call("start", fields));
  if (message) applySession(message);
}

async function loadLink() {
  const state = location.hash.slice("#state=".length);
  const message = await attempt(connection.call("load", { state }));
  if (message) applySession(message);
  else if (!session) start(starts.last());
}

function applySession(message) {
  const returning = session && session.session === message.session && message.id === 0;
  session = message;
  const first = new Set(message.branches.map(({ branch }) => branch));
  if (!returning) {
    if (message.id === 0 || !message.branches.some(({ length }) => length > 1)) clearButFirst();
    [current, beside, frame] = [0, null, 0];
  }
  message.branches.forEach(tree.setBranch);
  if (!first.has(current)) current = 0;
  if (!first.has(beside)) beside = null;
  starts.setSeed(message.seed);
  if (message.start.clip !== undefined) starts.setLast({ clip: message.start.clip });
  parts.sampling(message.settings);
  at("start").textContent = startText(message);
  layout();
  transport.resize(tree.length(current), returning ? frame : tree.length(current) - 1);
}

/** Forgets all frames but frame 0 of branch 0, which comes before the answer to a start. */
function clearButFirst() {
  const kinds = ["rgb", "depth", "truth", "truth_depth", "uncertainty"];
  const known = fresh.map((each) => each).filter(({ kind }) => kinds.includes(kind));
  tree.clear();
  asked.clear();
  known.forEach(tree.putFrame);
}

function startText({ start: from, task, clip_frames: frames }) {
  if (from.clip !== undefined) return `clip ${from.clip}: ${task}${frames ? `, ${frames} frames` : ""}`;
  const { from: [width, height], cropped: [side], to } = from.upload;
  const cut = width === height ? "" : `, its middle ${side} × ${side}`;
  return `your picture of ${width} × ${height}${cut}, as ${to} × ${to}`;
}

// ---- frames and steps

let fresh = []; // frames 0 of branch 0 since the last start

function gotFrame(got) {
  if (got.branch === 0 && got.frame === 0) {
    if (got.kind === "rgb") fresh = [];
    fresh.push(got);
  }
  tree.putFrame(got);
  if (got.kind !== "rgb") {
    redraw();
    return;
  }
  const following = got.branch === current && frame >= got.frame - 1;
  const key = pace.arrived(got.id);
  if (key === undefined) {
    redraw();
    return;
  }
  asked.add(`${got.branch} ${got.frame} ${["rgb", ...watched()]}`); // the rest follows by itself
  pending.push([got.frame, key]);
  if (following) transport.resize(tree.length(current), got.frame);
  else redraw();
  pace.pump();
}

function wants() {
  if (!ready() || halted || document.hidden) return false;
  const driving = parts.sources.name() === "stick" && parts.stick.driving();
  if (driving && frame < tree.length(current) - 1) {
    fork(frame);
    return false;
  }
  return driving || (transport.playing() && frame >= tree.length(current) - 1);
}

function send() {
  const fields = parts.sources.source() ?? { action: parts.stick.vector() };
  const answer = connection.call("step", { branch: current, ...fields });
  answer.then(
    (message) => {
      parts.server = message.ms;
      if (message.uncertainty !== null) parts.bits = message.uncertainty;
    },
    () => {},
  );
  return answer;
}

function failed(error) {
  transport.pause();
  halted = true;
  if (error.code !== "lost") note(error.message, true);
}

async function fork(from) {
  if (!ready()) return;
  forking = true;
  const message = await attempt(connection.call("fork", { branch: current, frame: from }));
  forking = false;
  if (!message) {
    halted = true;
    return;
  }
  tree.setBranch(message);
  beside ??= current;
  current = message.branch;
  layout();
  transport.resize(tree.length(current), message.fork);
  note(`branch ${message.branch} leaves at frame ${message.fork + 1}`);
  pace.pump();
}

function openBranch(branch) {
  if (branch === beside) beside = current;
  current = branch;
  transport.pause();
  layout();
  transport.resize(tree.length(current), Math.min(frame, tree.length(current) - 1));
}

function showBeside(branch) {
  beside = branch;
  layout();
  redraw();
}

async function dropBranch(branch) {
  if (!(await attempt(connection.call("drop", { branch })))) return;
  const { parent } = tree.branches.get(branch);
  tree.remove(branch);
  if (beside === branch) beside = null;
  if (current === branch) openBranch(parent);
  layout();
  redraw();
}

// ---- drawing

function moved(number) {
  frame = number;
  redraw();
}

function redraw() {
  if (dirty) return;
  dirty = true;
  requestAnimationFrame(draw);
}

async function draw() {
  dirty = false;
  if (!parts || !session) return;
  const shown = frame;
  fetchMissing();
  for (const view of parts.shown) {
    const branch = view === parts.beside ? beside : current;
    const drawn = view.draw(tree, branch, Math.min(shown, tree.length(branch) - 1), shows);
    if (view === parts.dream) drawn.then((done) => done && measured(shown));
  }
  captions(shown);
  branches.draw(tree, current, beside, shown);
  if (session.has_truth && shows.truth) drawChart(shown);
}

function measured(shown) {
  const times = [];
  while (pending.length && pending[0][0] <= shown) times.push(pending.shift()[1]);
  if (times.length) pace.drawn(times);
  if (pending.length > 8) pending.length = 0;
}

function captions(shown) {
  const score = tree.score(current, shown);
  parts.dream.caption.textContent = beside === null ? "dream" : `branch ${current}`;
  parts.dream.note.textContent = score?.psnr ? `${score.psnr.toFixed(1)} dB, mean ${score.mean.toFixed(1)}` : "";
  const other = beside === null ? null : tree.score(beside, shown);
  parts.beside.caption.textContent = `branch ${beside}`;
  parts.beside.note.textContent = other?.psnr ? `${other.psnr.toFixed(1)} dB, mean ${other.mean.toFixed(1)}` : "";
}

function drawChart(shown) {
  const lines = [current, beside].filter((branch) => branch !== null);
  const series = lines.map((branch) => ({ name: `branch ${branch}`, values: tree.psnr(branch) }));
  chart.draw(series, shown, Math.max(...lines.map(tree.length)));
}

/** Asks for frames that are to be shown and were never sent to this page. */
function fetchMissing() {
  const kinds = ["rgb", ...watched()];
  for (const branch of new Set([current, beside ?? current])) {
    const place = Math.min(frame, tree.length(branch) - 1);
    const owner = tree.owner(branch, place);
    const block = Math.floor(place / BLOCK) * BLOCK;
    const names = [`${owner} ${place} ${kinds}`, `${branch} ${block} ${kinds}`];
    const lacks = kinds.some((kind) => kind !== "points" && !tree.frame(branch, kind, place));
    if (!lacks || names.some((name) => asked.has(name))) continue;
    asked.add(names[1]);
    attempt(connection.call("frames", { branch, first: block, count: Math.min(BLOCK, tree.length(branch) - block), kinds }));
  }
}

function watched() {
  const truth = session?.has_truth !== false && shows.truth && !welcome.truth;
  return [
    ...(shows.depth && welcome.run.has_depth ? ["depth"] : []),
    ...(shows.uncertainty ? ["uncertainty"] : []),
    ...(truth ? ["truth"] : []),
    ...(truth && shows.depth && welcome.run.has_depth ? ["truth_depth"] : []),
    ...(shows.points ? ["points"] : []),
  ];
}

function watch() {
  attempt(connection.call("watch", { kinds: watched() }));
}

function layout() {
  const truth = shows.truth && session?.has_truth;
  parts.shown = [parts.dream, ...(truth ? [parts.truth] : []), ...(beside === null ? [] : [parts.beside])];
  at("panes").replaceChildren(...parts.shown.map(({ figure }) => figure));
  at("panes").dataset.columns = parts.shown.length;
  at("panes").classList.toggle("with-depth", Boolean(shows.depth && session?.has_depth));
  at("panes").classList.toggle("smooth", shows.smooth);
  at("truth-card").hidden = !truth;
  at("depth-scale").hidden = !(shows.depth && session?.has_depth);
}

// ---- building the page once

function build() {
  const { run, controls, sources, limits, settings, truth } = welcome;
  document.title = `rsjax · play · ${run.name}`;
  at("run").textContent = `${run.name} · ${run.image_size} × ${run.image_size} · ${run.device}`;
  const view = (title, kinds) => makeView({ title, kinds, size: run.image_size, depthRange: run.depth_range ?? [0.1, 10] });
  parts = {
    dream: view("dream", ["rgb", "depth"]),
    truth: view("simulator", ["truth", "truth_depth"]),
    beside: view("dream beside", ["rgb", "depth"]),
    stick: makeStick({ controls, host: at("controls"), switches: at("toggles"), pad: at("pad"), changed: touched }),
    sources: makeSources({ host: at("source"), sources, clips: run.clips, changed: sourceChanged }),
    sampling: makeSampling({ host: at("sampling"), limits, settings, changed: (fields) => attempt(connection.call("settings", fields)) }),
    shown: [],
  };
  parts.toggle = makeChecks({
    host: at("views"),
    states: shows,
    changed: viewChanged,
    rows: [
      ["depth", "depth", "1", run.has_depth ? "" : "the run has none"],
      ["truth", "simulator", "2", truth],
      ["points", "keypoints", "3", ""],
      ["uncertainty", "uncertainty", "4", ""],
      ["smooth", "smooth pictures", "5", ""],
    ],
  });
  makeKeep({
    host: at("keep"), call: connection.call, fps: run.fps, note,
    view: () => ({ branch: current, beside, truth: shows.truth && session.has_truth, depth: shows.depth && session.has_depth }),
  });
  at("transport").append(transport.controls);
  at("chart").append(chart.host);
  if (run.has_depth) at("depth-scale").append(...scale(run.depth_range));
  showKeys(at("key-list"), keyList());
  setInterval(meter, 500);
  setInterval(measureTrip, 5000);
  addEventListener("gamepadconnected", () => requestAnimationFrame(pollGamepad));
}

function scale([near, far]) {
  const bar = element("i", {});
  const colors = Array.from({ length: 12 }, (_, place) => `rgb(${turbo(place / 11)})`);
  bar.style.background = `linear-gradient(to right, ${colors.join(", ")})`;
  return [element("span", {}, `${near.toPrecision(3)} m`), bar, element("span", {}, `${far.toPrecision(3)} m`)];
}

function viewChanged(name) {
  keep("view", shows);
  asked.clear();
  if (name !== "smooth") watch();
  layout();
  redraw();
}

function sourceChanged(name) {
  halted = false;
  at("controls").classList.toggle("idle", name !== "stick");
}

function touched(time) {
  halted = false;
  if (!parts || !session) return;
  if (parts.sources.name() === "stick" && (parts.stick.driving() || transport.playing())) pace.touch(time);
}

function pollGamepad() {
  if (parts.stick.poll()) requestAnimationFrame(pollGamepad);
}

async function measureTrip() {
  if (document.hidden || pace.flying()) return;
  const sent = performance.now();
  const answer = await connection.call("ping").catch(() => null);
  if (answer) pace.setTrip(performance.now() - sent);
}

function meter() {
  const { rate, p50, p95, count } = pace.figures();
  const milliseconds = (value) => (value === undefined ? "–" : `${Math.round(value)} ms`);
  const rows = [
    ["frames a second", rate ? rate.toFixed(1) : "–"],
    ["key to picture", `${milliseconds(p50)}, 95 % within ${milliseconds(p95)}`],
    ["server", parts.server === undefined ? "–" : milliseconds(parts.server)],
    ...(shows.uncertainty && parts.bits !== undefined ? [["uncertainty", `${parts.bits.toFixed(2)} bits a cell`]] : []),
  ];
  at("meter").dataset.keys = count;
  at("meter").replaceChildren(...rows.flatMap(([name, text]) => [element("div", {}, element("dt", {}, name), element("dd", {}, text))]));
}

// ---- keys

const KEYS = {
  KeyB: () => fork(frame),
  KeyC: () => at("open-clips").click(),
  Digit1: () => parts.toggle("depth"),
  Digit2: () => parts.toggle("truth"),
  Digit3: () => parts.toggle("points"),
  Digit4: () => parts.toggle("uncertainty"),
  Digit5: () => parts.toggle("smooth"),
};

function keyList() {
  return [
    ...parts.stick.keys,
    [["Shift"], "with these: gently"],
    [["X"], "all sliders to rest"],
    [["Space"], "play: frames that there are, then new ones"],
    [["←", "→"], "a frame back and on; at the end a new one"],
    [["Home", "End"], "the first and the last frame"],
    [["<", ">"], "slower, faster"],
    [["B"], "branch here"],
    [["C"], "start from another clip or a picture"],
    [["1", "…", "5"], "depth, simulator, keypoints, uncertainty, smooth pictures"],
    [["gamepad"], "left stick: the first two; right stick: the third and the last turn; A: gripper"],
  ];
}

function typed(event) {
  if (!parts || !session || keepsKey(event)) return;
  if (event.key === "?") at("open-keys").click();
  else if (parts.stick.key(event)) event.preventDefault();
  else if (!event.ctrlKey && !event.metaKey && !event.altKey && KEYS[event.code] && !event.repeat) KEYS[event.code]();
  else if (transport.key(event)) event.preventDefault();
}

document.addEventListener("keydown", typed);
document.addEventListener("keyup", (event) => parts?.stick.key(event));
addEventListener("blur", () => parts?.stick.rest());
addEventListener("hashchange", () => location.hash.startsWith("#state=") && parts && loadLink());
at("rest").addEventListener("click", () => parts?.stick.rest());
at("branch-here").addEventListener("click", () => parts && fork(frame));
at("open-keys").addEventListener("click", () => at("keys").showModal());
useTheme(at("theme"));
