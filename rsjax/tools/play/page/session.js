// The session: its start, its steps and its branches.
import { askAgain, drawStep, expect, layout, redraw, watched } from "./drawing.js";
import { at, attempt, lastFrame, note, ready, rememberLink, state, tree } from "./state.js";

/** Starts from a clip or the last upload. */
export function start(fields) {
  return begin("start", fields);
}

/** Makes the frames of the link in this page's address again. */
export async function loadLink(otherwise) {
  const { hash } = location;
  const made = await begin("load", { state: hash.slice("#state=".length) });
  if (made) rememberLink(hash);
  else if (!state.session) start(otherwise);
}

async function begin(type, fields) {
  state.transport.pause();
  state.incoming = [];
  const call = state.connection.call(type, fields);
  const message = await attempt(call);
  const came = state.incoming.filter(({ id }) => id === call.id); // not of a step in the session before
  state.incoming = null;
  if (!message) return false;
  state.session = null;
  tree.clear();
  askAgain();
  [state.current, state.beside] = [0, null];
  applySession(message);
  came.forEach(tree.putFrame);
  const { length } = tree.branches.get(state.current);
  state.transport.resize(length, length - 1);
  return true;
}

/** Takes over what a `session` message says; also after a lost connection was found again. */
export function applySession(message) {
  const truth = state.session?.has_truth;
  state.truthOff = "";
  state.session = message;
  tree.branches.clear();
  message.branches.forEach(tree.setBranch);
  if (!tree.branches.has(state.current)) state.current = 0;
  if (!tree.branches.has(state.beside)) state.beside = null;
  state.parts.starts.taken(message);
  state.parts.sampling(message.settings);
  at("start").textContent = startText(message);
  if (truth !== message.has_truth) attempt(state.connection.call("watch", { kinds: watched() }));
  layout();
  state.transport.resize(tree.length(state.current), state.frame);
}

function startText({ start: from, task, clip_frames: frames }) {
  if (from.clip !== undefined) return `clip ${from.clip}: ${task}${frames ? `, ${frames} frames` : ""}`;
  const { from: [width, height], cropped: [side], to } = from.upload;
  const cut = width === height ? "" : `, its middle ${side} × ${side}`;
  return `your picture of ${width} × ${height}${cut}, as ${to} × ${to}`;
}

/** Takes a frame that came. */
export function takeFrame(got) {
  const key = got.kind === "rgb" ? state.pace.arrived(got.id) : undefined;
  if (state.incoming) {
    state.incoming.push(got);
    return;
  }
  tree.putFrame(got);
  if (key === undefined) {
    redraw();
    return;
  }
  expect(got.branch, got.frame);
  if (got.branch === state.current && state.frame >= got.frame - 1) {
    state.transport.resize(tree.length(state.current), got.frame);
    drawStep(got.frame, key);
  } else redraw();
  state.pace.pump();
}

/** Takes the PSNR or the points of a frame. */
export function takeFacts(message) {
  if (state.incoming) return; // of the session before; the new one is asked again
  if (message.type === "truth") tree.putScore(message);
  else tree.putPoints(message);
  redraw();
}

/** Returns whether a frame is wanted now; an earlier frame is branched from first. */
export function wants() {
  if (!ready() || state.halted || state.incoming || document.hidden) return false;
  const { parts, transport } = state;
  const driving = parts.sources.name() === "stick" && parts.stick.driving();
  if (driving && state.frame < lastFrame()) {
    fork(state.frame);
    return false;
  }
  return driving || (transport.playing() && state.frame >= lastFrame());
}

/** Sends a step. */
export function send() {
  const { parts, connection, current } = state;
  const fields = parts.sources.source() ?? { action: parts.stick.take() };
  const answer = connection.call("step", { branch: current, ...fields });
  answer.then(
    (message) => {
      parts.server = message.ms;
      if (message.uncertainty !== null) parts.bits = message.uncertainty;
      tree.putCoverage(message);
    },
    () => {}, // the pace has it too
  );
  return answer;
}

/** Stops after a step that failed. */
export function failed(error) {
  state.transport.pause();
  state.halted = true;
  if (error.code !== "lost") note(error.message, true);
}

/** Makes a branch that leaves the current one at a frame, and drives it. */
export async function fork(frame) {
  if (!ready()) return;
  state.forking = true;
  const message = await attempt(state.connection.call("fork", { branch: state.current, frame }));
  state.forking = false;
  if (!message) {
    state.halted = true;
    return;
  }
  tree.setBranch(message);
  [state.beside, state.current] = [state.current, message.branch];
  layout();
  state.transport.resize(message.length, message.fork);
  note(`branch ${message.branch} leaves at frame ${message.fork + 1}`);
  state.pace.pump();
}

/** Drives another branch. */
export function openBranch(branch) {
  if (branch === state.beside) state.beside = state.current;
  state.current = branch;
  state.transport.pause();
  layout();
  state.transport.resize(tree.length(branch), Math.min(state.frame, lastFrame()));
}

/** Shows a branch beside the current one; null: none. */
export function compareBranch(branch) {
  state.beside = branch;
  layout();
  redraw();
}

/** Removes a branch. */
export async function dropBranch(branch) {
  if (!(await attempt(state.connection.call("drop", { branch })))) return;
  const { parent } = tree.branches.get(branch);
  if (state.current === branch) openBranch(parent);
  tree.remove(branch);
  if (state.beside === branch || state.beside === state.current) state.beside = null;
  layout();
  redraw();
}
