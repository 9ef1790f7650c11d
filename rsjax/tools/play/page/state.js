// What the page's parts share: the session as this page sees it, and the parts themselves.
import { makeTree } from "./tree.js";
import { kept, makeBanner, makeNotes } from "./ui.js";

const LINK = "rsjax-link"; // the link that this window has loaded or made, which a reload need not load again

export const at = (id) => document.getElementById(id);
export const note = makeNotes(at("notes"));
export const banner = makeBanner(at("banner"));
export const tree = makeTree();

export const state = {
  welcome: null,
  session: null, // the last `session` message
  current: 0, // the branch that is driven
  beside: null, // the branch shown beside it
  frame: 0,
  forking: false,
  halted: false, // after a step that failed, until the next key
  incoming: null, // messages since a start was asked for, until its answer
  parts: null, // what the welcome describes: stick, sources, views …
  truthOff: "", // why the simulator does not follow
  connection: null,
  transport: null,
  pace: null,
  shows: kept("view", { depth: true, truth: true, points: false, uncertainty: false, smooth: false }),
};

/** Returns whether frames can be made and drawn. */
export function ready() {
  return state.parts !== null && state.session !== null && !state.forking;
}

/** Returns the last frame of the current branch. */
export function lastFrame() {
  return tree.length(state.current) - 1;
}

/** Remembers that this window's session has come from a link, or is kept in it. */
export function rememberLink(hash) {
  sessionStorage.setItem(LINK, hash);
}

/** Returns whether the page's address has another link than the one that this window has loaded or made. */
export function hasNewLink() {
  return location.hash !== "" && location.hash !== sessionStorage.getItem(LINK);
}

/** Returns a promise's value; null where it failed, after saying why. */
export async function attempt(promise) {
  try {
    return await promise;
  } catch (error) {
    if (error.code !== "lost") note(error.message, true);
    return null;
  }
}
