// The list of branches: a bar over their frames for each, from where it left another.
import { element } from "./player/dom.js";

/**
 * Makes the list.
 * @param open called with a branch to drive, compare with one to show beside it (or null), drop with one to remove.
 */
export function makeBranches({ host, open, compare, drop }) {
  function draw(tree, current, beside, frame) {
    const longest = Math.max(2, ...[...tree.branches.values()].map(({ length }) => length));
    host.replaceChildren(...tree.ordered().map((each) => row(each, tree, { current, beside, frame, longest })));
  }

  function row(each, tree, { current, beside, frame, longest }) {
    const { branch, parent, fork, length, depth } = each;
    const from = parent === null ? 0 : fork;
    const bar = element("i", { class: "bar" });
    bar.style.marginLeft = `${(100 * from) / longest}%`;
    bar.style.width = `${Math.max(1.5, (100 * (length - from)) / longest)}%`;
    const cursor = branch === current ? element("i", { class: "here" }) : null;
    if (cursor) cursor.style.left = `${(100 * Math.min(frame + 0.5, length)) / longest}%`;
    const text = parent === null ? "start" : `from frame ${fork + 1} of ${parent}`;
    const leaf = parent !== null && ![...tree.branches.values()].some((other) => other.parent === branch);
    const main = element(
      "button",
      { type: "button", class: "branch", "aria-pressed": branch === current, onclick: () => open(branch) },
      element("span", { class: "branch-name" }, element("b", {}, `${branch}`), ` ${text}`),
      element("span", { class: "faint" }, `${length} frames`),
      element("span", { class: "track" }, bar, cursor),
    );
    main.style.marginLeft = `${Math.min(depth, 6) * 0.6}rem`;
    const side = element(
      "button",
      { type: "button", class: "small", "aria-pressed": branch === beside, disabled: branch === current, "aria-label": `show branch ${branch} beside`,
        title: "show beside", onclick: () => compare(branch === beside ? null : branch) },
      "beside",
    );
    const remove = leaf
      ? element("button", { type: "button", class: "small", "aria-label": `remove branch ${branch}`, title: "remove", onclick: () => drop(branch) }, "✕")
      : null;
    return element("li", {}, main, side, remove);
  }

  return { draw };
}
