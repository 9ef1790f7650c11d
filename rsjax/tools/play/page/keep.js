// What is kept: a video, clips of a store, and a link.
import { address } from "./connection.js";
import { element } from "./player/dom.js";
import { note, rememberLink } from "./state.js";

function select(name, values) {
  return element("select", { "aria-label": name }, ...values.map(([value, text]) => element("option", { value }, text)));
}

/**
 * Makes the forms.
 * @param call sends a message and returns the promise of its answer.
 * @param view returns {branch, beside, truth, depth}: what is shown now.
 */
export function makeKeep({ host, call, view, fps }) {
  const format = select("format", [["mp4", "MP4"], ["gif", "GIF"]]);
  const scale = select("size", [[4, "4 × as large"], [1, "as it is"], [2, "2 ×"], [8, "8 ×"]]);
  const rate = element("input", { type: "number", min: 1, max: 60, step: 1, value: Math.max(1, Math.round(fps)), "aria-label": "frames a second" });
  const files = element("ul", { class: "files" });
  const row = (...parts) => element("p", { class: "row" }, ...parts);
  const button = (text, act) => element("button", { type: "button", onclick: ({ target }) => run(target, act) }, text);
  host.replaceChildren(
    row(format, scale, element("label", {}, rate, " frames/s"), button("Record this branch", record)),
    row(button("Export all branches as clips", exportClips), button("Copy a link to this state", copyLink)),
    files,
  );

  async function run(target, act) {
    target.disabled = true;
    try {
      await act();
    } catch (error) {
      note(error.message, true);
    }
    target.disabled = false;
  }

  async function record() {
    const { branch, beside, truth, depth } = view();
    const panes = ["rgb", ...(depth ? ["depth"] : []), ...(truth ? ["truth"] : []), ...(beside === null ? [] : [`branch:${beside}`])];
    add(await call("record", { branch, format: format.value, fps: Number(rate.value) || 5, panes, scale: Number(scale.value) }));
  }

  async function exportClips() {
    add(await call("export"));
  }

  function add({ name, url, bytes, path }) {
    const size = bytes < 1e6 ? `${Math.ceil(bytes / 1000)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
    const link = element("a", { href: address(url), download: name }, name);
    files.prepend(element("li", {}, link, ` ${size}`, element("small", {}, path ?? "")));
    link.click();
    note(`saved ${name} (${size})`);
  }

  async function copyLink() {
    const { state } = await call("link");
    const url = new URL(location.href);
    url.hash = `state=${state}`;
    history.replaceState(null, "", url);
    rememberLink(url.hash);
    // There is no clipboard over plain http, except from the loopback address.
    const copied = await navigator.clipboard?.writeText(url.href).then(() => true, () => false);
    note(`the link ${copied ? "is copied" : "stands in the address bar"}: it makes these frames again, bit for bit`);
  }
}
