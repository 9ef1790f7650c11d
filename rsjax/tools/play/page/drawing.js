// Draws the shown frame of the shown branches, the list and the chart, and asks for frames that are missing.
import { at, attempt, state, tree } from "./state.js";

const BLOCK = 32; // frames asked for at once
const APART = 100; // milliseconds between two drawings of the list and the chart
const UNSEEN = 0.99; // of the training frames are nearer to the others: the model has not seen this
const MOST_TRIES = 5; // to get a frame's pictures again
const asked = new Set();
const pending = []; // frames to be drawn whose time is measured: [frame, time of the key or null]
let dirty = false;
let later = 0;
let late = ""; // the frame that was asked for again, and how often
let tries = 0;

/** Forgets which frames were asked for. */
export function askAgain() {
  asked.clear();
}

/** Draws with the next picture of the screen. */
export function redraw() {
  if (dirty) return;
  dirty = true;
  requestAnimationFrame(() => dirty && draw());
}

/** Draws a frame that a step made, at once. */
export function drawStep(frame, key) {
  pending.push([frame, key]);
  draw();
}

/** Notes that whatever is watched follows a step's frame by itself. */
export function expect(branch, frame) {
  asked.add(`${branch} ${frame} ${["rgb", ...watched()]}`);
}

function draw() {
  dirty = false;
  const { parts, session, frame, current, beside, shows } = state;
  if (!parts || !session) return;
  fetchMissing();
  for (const view of parts.shown) {
    const branch = view === parts.beside ? beside : current;
    const drawn = view.draw(tree, branch, Math.min(frame, tree.length(branch) - 1), shows);
    if (view === parts.dream) drawn.then((done) => done && requestAnimationFrame(() => measured(frame)));
  }
  caption(parts.dream, current, beside === null ? "dream" : `branch ${current}`);
  parts.truth.note.textContent = tree.frame(current, "truth", frame) ? "" : state.truthOff ? "stays behind" : "catching up …";
  parts.truth.note.title = state.truthOff;
  if (beside !== null) caption(parts.beside, beside, `branch ${beside}`);
  later ||= setTimeout(drawAside, APART);
}

function measured(frame) {
  const times = [];
  while (pending.length && pending[0][0] <= frame) times.push(pending.shift()[1]);
  if (times.length) state.pace.drawn(times);
  if (pending.length > 8) pending.length = 0;
}

function caption(view, branch, title) {
  const score = tree.score(branch, state.frame);
  view.caption.textContent = title;
  view.note.textContent = score?.psnr ? `${score.psnr.toFixed(1)} dB, mean ${score.mean.toFixed(1)}` : "";
}

function drawAside() {
  const { parts, session, frame, current, beside, shows } = state;
  later = 0;
  if (!session) return;
  parts.branches.draw(tree, current, beside, frame);
  if (!session.has_truth || !shows.truth) return;
  const lines = [current, beside].filter((branch) => branch !== null);
  const series = lines.map((branch) => ({ name: `branch ${branch}`, values: tree.psnr(branch) }));
  parts.chart.draw(series, frame, Math.max(...lines.map(tree.length)));
}

function lacks(branch, place, kinds) {
  return kinds.some((kind) => kind !== "points" && !tree.frame(branch, kind, place));
}

/** Asks again for what a still picture lacks: a busy server drops pushed pictures. Call it every few seconds. */
export function askLate() {
  const { session, pace, current, frame } = state;
  const place = `${current} ${frame}`;
  [late, tries] = [place, place === late ? tries : 0];
  if (!session || pace.flying() || tries >= MOST_TRIES || !lacks(current, frame, watched())) return;
  tries += 1;
  askAgain();
  redraw();
}

/** Asks for frames that are to be shown and were never sent to this page. */
function fetchMissing() {
  const kinds = ["rgb", ...watched()];
  for (const branch of new Set([state.current, state.beside ?? state.current])) {
    const place = Math.min(state.frame, tree.length(branch) - 1);
    const block = Math.floor(place / BLOCK) * BLOCK;
    const names = [`${tree.owner(branch, place)} ${place} ${kinds}`, `${branch} ${block} ${kinds}`];
    if (!lacks(branch, place, kinds) || names.some((name) => asked.has(name))) continue;
    asked.add(names[1]);
    const count = Math.min(BLOCK, tree.length(branch) - block);
    attempt(state.connection.call("frames", { branch, first: block, count, kinds }));
  }
}

/** Returns the kinds of pictures that are to follow each frame. */
export function watched() {
  const { welcome, session, shows } = state;
  const truth = session?.has_truth !== false && shows.truth && !welcome.truth;
  const depth = shows.depth && welcome.run.has_depth;
  return [
    ...(depth ? ["depth"] : []),
    ...(shows.uncertainty ? ["uncertainty"] : []),
    ...(truth ? ["truth"] : []),
    ...(truth && depth ? ["truth_depth"] : []),
    ...(shows.points ? ["points"] : []),
  ];
}

/** Puts the views that are to be shown in their places. */
export function layout() {
  const { parts, session, beside, shows } = state;
  const truth = shows.truth && session?.has_truth;
  const depth = Boolean(shows.depth && session?.has_depth);
  parts.shown = [parts.dream, ...(truth ? [parts.truth] : []), ...(beside === null ? [] : [parts.beside])];
  at("panes").replaceChildren(...parts.shown.map(({ figure }) => figure));
  at("panes").dataset.columns = parts.shown.length;
  at("panes").classList.toggle("with-depth", depth);
  at("panes").classList.toggle("smooth", shows.smooth);
  at("truth-card").hidden = !truth;
  at("depth-scale").hidden = !depth;
}

/** Shows how fast the page is. */
export function meter() {
  const { rate, p50, p95, count } = state.pace.figures();
  const milliseconds = (value) => (value === undefined ? "–" : `${Math.round(value)} ms`);
  const { server, bits } = state.parts;
  const share = tree.coverageAt(state.current, state.frame);
  const values = {
    rate: rate ? rate.toFixed(1) : "–",
    key: `${milliseconds(p50)}, 95 % within ${milliseconds(p95)}`,
    server: milliseconds(server),
    coverage: familiar(share),
    bits: state.shows.uncertainty && bits !== undefined ? `${bits.toFixed(2)} bits a cell` : "–",
  };
  at("meter").dataset.keys = count;
  for (const each of at("meter").querySelectorAll("dd")) each.textContent = values[each.dataset.value];
  at("bits").hidden = !state.shows.uncertainty;
  at("coverage").hidden = share === undefined;
  at("coverage").classList.toggle("alarm", share > UNSEEN);
}

/** Says how far a frame is from what the model was trained on. */
function familiar(share) {
  if (share === undefined) return "–";
  return share > UNSEEN ? "the model has not seen this" : `farther than ${Math.round(100 * share)} % of it`;
}
