// The list of branches: for each a bar over its frames, from where it left another.
import { element } from "./player/dom.js";

const INDENT = 0.6; // rem
const DEEPEST = 6; // steps of indentation

/**
 * Makes the list.
 * @param open called with a branch to drive, compare with one to show beside it (or null), drop with one to remove.
 */
export function makeBranches({ host, open, compare, drop }) {
  const rows = new Map(); // kept while their branches last, so that buttons keep the focus

  function draw(tree, current, beside, frame) {
    const all = tree.ordered();
    const longest = Math.max(2, ...all.map(({ length }) => length));
    const parents = new Set(all.map(({ parent }) => parent));
    for (const branch of rows.keys()) if (!tree.branches.has(branch)) rows.delete(branch);
    for (const each of all) {
      if (!rows.has(each.branch)) rows.set(each.branch, makeRow(each.branch));
      rows.get(each.branch).show(each, { current, beside, frame, longest, leaf: !parents.has(each.branch) });
    }
    const items = all.map(({ branch }) => rows.get(branch).item);
    if (items.length !== host.children.length || items.some((item, place) => item !== host.children[place])) {
      host.replaceChildren(...items);
    }
  }

  function makeRow(branch) {
    let shown = false; // beside the current one
    const [name, count] = [element("span", {}), element("span", { class: "faint" })];
    const [bar, here] = [element("i", { class: "bar" }), element("i", { class: "here" })];
    const main = element(
      "button",
      { type: "button", class: "branch", onclick: () => open(branch) },
      element("span", { class: "branch-name" }, element("b", {}, `${branch}`), " ", name),
      count,
      element("span", { class: "track" }, bar, here),
    );
    const small = { type: "button", class: "small" };
    const label = `show branch ${branch} beside`;
    const side = element("button", { ...small, "aria-label": label, onclick: () => compare(shown ? null : branch) }, "beside");
    const remove = element("button", { ...small, "aria-label": `remove branch ${branch}`, onclick: () => drop(branch) }, "✕");

    function show({ parent, fork, length, depth }, { current, beside, frame, longest, leaf }) {
      const from = parent === null ? 0 : fork;
      const percent = (frames) => `${(100 * frames) / longest}%`;
      shown = branch === beside;
      name.textContent = parent === null ? "start" : `from frame ${fork + 1} of ${parent}`;
      count.textContent = `${length} frames`;
      main.style.marginLeft = `${Math.min(depth, DEEPEST) * INDENT}rem`;
      main.setAttribute("aria-pressed", branch === current);
      side.setAttribute("aria-pressed", shown);
      side.disabled = branch === current;
      remove.hidden = parent === null || !leaf;
      [bar.style.marginLeft, bar.style.width] = [percent(from), percent(length - from)];
      here.hidden = branch !== current;
      here.style.left = percent(Math.min(frame + 0.5, length));
    }

    return { item: element("li", {}, main, side, remove), show };
  }

  return { draw };
}
