// The page's beginning: the connection, and what each message from the server leads to.
import { build } from "./build.js";
import { connect } from "./connection.js";
import { askAgain, redraw, watched } from "./drawing.js";
import { makePace } from "./pace.js";
import { makeTransport } from "./player/transport.js";
import { applySession, failed, loadLink, send, start, takeFacts, takeFrame, wants } from "./session.js";
import { makeStarts } from "./starts.js";
import { at, attempt, banner, hasNewLink, note, ready, state } from "./state.js";
import { useTheme } from "./ui.js";

const FAST = 1000; // frames a second: as fast as it goes
const RATES = [1, 2, 5, 10].map((rate) => [rate, `${rate} frame${rate > 1 ? "s" : ""}/s`]);
const KEPT = "rsjax-session"; // the session of this window, to which a reload returns
const CLOSED = {
  4401: "The token is missing or wrong: open the address that the server printed.",
  4403: "The server refuses this address: open the one that it printed.",
  4408: "This session was freed, since nothing happened for a while.",
  4409: "This session was opened in another window.",
  4429: "The server is full.",
  1008: "The server closed the connection: too many messages.",
};

state.pace = makePace({ wants, send, rate: () => state.transport.rate(), failed });
state.transport = makeTransport({
  count: 1,
  rate: FAST,
  choices: [...RATES, [FAST, "full speed"]],
  show(frame) {
    state.frame = frame;
    redraw();
  },
  beyond: () => ready() && !state.pace.flying() && state.pace.step(), // a held key repeats faster than frames come
  changed() {
    state.halted = false;
    if (ready()) state.pace.pump();
  },
});
state.connection = connect({
  session: () => sessionStorage.getItem(KEPT),
  on: { open: greeted, message: received, frame: takeFrame, lost, closed },
});
const starts = makeStarts({ start, upload: state.connection.upload, note });

function greeted(message) {
  const again = state.welcome !== null;
  state.welcome = message;
  sessionStorage.setItem(KEPT, message.session);
  banner.hide();
  health("connected", "");
  state.pace.reset();
  askAgain();
  if (!again) build();
  state.parts.starts = starts;
  attempt(state.connection.call("watch", { kinds: watched() }));
  if (message.returned && (again || !hasNewLink())) return; // its session follows
  if (again) note("The server knows this session no more: it starts again.", true);
  if (location.hash.startsWith("#state=")) loadLink(starts.last());
  else if (message.run.clips || starts.last().upload) beginAgain();
  else starts.open(); // without clips, a picture is what can be begun with
}

/** Starts as before; an upload is forgotten with its session. */
async function beginAgain() {
  const begun = await start(starts.last());
  if (!begun && starts.last().upload && state.welcome.run.clips) start({ clip: 0 });
}

function received(message) {
  if (message.type === "truth_off") state.truthOff = message.message;
  if (message.type === "session") applySession(message);
  else if (message.type === "truth" || message.type === "points") takeFacts(message);
  else if (message.type === "truth_off" || message.type === "error") note(message.message, true);
  else if (message.type === "status") health(message.text, message.busy ? "busy" : "");
  else if (message.type === "progress") {
    health(`${message.what} ${message.done} of ${message.total}`, message.done < message.total ? "busy" : "");
  }
}

function health(text, mood) {
  const words = text || "connected";
  const shown = at("health").lastElementChild;
  at("health").dataset.state = mood;
  if (shown.textContent !== words) shown.textContent = words;
}

function lost(wait) {
  stop();
  banner.show(`The connection was lost. Trying again in ${Math.ceil(wait / 1000)} s.`, "Try now", state.connection.again);
}

function closed(code, reason) {
  stop();
  if (code !== 4429) sessionStorage.removeItem(KEPT);
  const text = code === 4429 && reason ? reason : CLOSED[code];
  banner.show(text, code === 4408 ? "Start again" : "Try again", state.connection.again);
}

function stop() {
  state.transport.pause();
  state.pace.reset();
  health("not connected", "lost");
}

addEventListener("hashchange", () => location.hash.startsWith("#state=") && state.parts && loadLink(starts.last()));
at("open-keys").addEventListener("click", () => at("keys").showModal());
useTheme(at("theme"));
