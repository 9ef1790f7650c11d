// The smaller parts of the page: theme, notes, the banner, and forms that the server's welcome describes.
import { element } from "./player/dom.js";

const SECONDS = 6; // that a note stays

/** Returns a value kept in this browser, or another where there is none or keeping is refused. */
export function kept(name, otherwise) {
  try {
    return JSON.parse(localStorage.getItem(`rsjax-${name}`)) ?? otherwise;
  } catch {
    return otherwise;
  }
}

export function keep(name, value) {
  try {
    localStorage.setItem(`rsjax-${name}`, JSON.stringify(value));
  } catch {
    // private windows may refuse
  }
}

export function useTheme(select) {
  const use = (theme) => (document.documentElement.dataset.theme = theme);
  select.value = kept("theme", "auto");
  use(select.value);
  select.addEventListener("change", () => {
    keep("theme", select.value);
    use(select.value);
  });
}

/** Makes the function that shows one line for some seconds; an error stays twice as long. */
export function makeNotes(host) {
  let timer = 0;
  return (text, error = false) => {
    clearTimeout(timer);
    host.textContent = text;
    host.classList.toggle("error", error);
    host.classList.add("shown");
    timer = setTimeout(() => host.classList.remove("shown"), 1000 * SECONDS * (error ? 2 : 1));
  };
}

/** Makes the functions that show a message across the page until it is hidden. */
export function makeBanner(host) {
  const [text, button] = host.children;
  button.addEventListener("click", () => button.act());
  return {
    show(message, label, act) {
      if (text.textContent !== message) text.textContent = message;
      button.textContent = label;
      button.act = act;
      host.hidden = false;
    },
    hide: () => (host.hidden = true),
  };
}

/** Fills the choice of where actions come from; what there is not shows its reason. */
export function makeSources({ host, sources, clips, changed }) {
  const texts = { stick: "you, by the stick", clip: "the clip's own actions", other: "another clip's actions", random: "random actions",
    policy: "the policy", planner: "the planner" };
  const known = { ...sources, other: sources.clip };
  const options = Object.keys(texts).map((name) => {
    const reason = known[name] ?? "not here";
    return element("option", { value: name, disabled: Boolean(reason) }, `${texts[name]}${reason ? `: ${reason}` : ""}`);
  });
  const select = element("select", { id: "source-select" }, ...options);
  const clip = element("input", { type: "number", min: 0, max: Math.max(0, clips - 1), step: 1, value: Math.min(1, clips - 1), "aria-label": "clip" });
  const update = () => {
    clip.hidden = select.value !== "other";
    changed(select.value);
  };
  select.addEventListener("change", update);
  clip.addEventListener("change", update);
  host.replaceChildren(element("label", { class: "row" }, "actions from ", select), clip);
  clip.hidden = true;

  /** Returns the fields of a step message, or null for the stick. */
  function source() {
    if (select.value === "stick") return null;
    if (select.value === "other") return { source: { kind: "clip", clip: Number(clip.value) } };
    return { source: { kind: select.value } };
  }

  return { source, name: () => select.value };
}

/** Fills a list of check boxes: [name, label, key, reason why there is none]. Returns a function that toggles one. */
export function makeChecks({ host, rows, states, changed }) {
  const boxes = new Map();
  for (const [name, label, key, reason] of rows) {
    const box = element("input", { type: "checkbox", disabled: Boolean(reason) });
    box.checked = !reason && Boolean(states[name]);
    box.addEventListener("change", () => {
      states[name] = box.checked;
      changed(name);
    });
    boxes.set(name, box);
    host.append(element("label", { class: "check", title: reason || null }, box, label, " ", element("kbd", {}, key), reason ? element("small", {}, reason) : null));
  }
  return (name) => boxes.get(name)?.click();
}

/** Fills the sliders of sampling. Returns a function that shows the server's settings. */
export function makeSampling({ host, limits, settings, changed }) {
  const ranges = {
    temperature: ["temperature", 0, 2, 0.05],
    steps: ["steps per frame", 1, limits.steps, 1],
    guidance: ["guidance", ...limits.guidance, 0.1],
    top_k: ["top k (0: all)", 0, limits.top_k, 1],
  };
  const shows = Object.entries(ranges).map(([name, [label, low, high, step]]) => {
    const input = element("input", { type: "range", min: low, max: high, step, disabled: low === high });
    const output = element("output", {});
    const show = (value) => ([input.value, output.textContent] = [value, low === high ? "not in this model" : `${+Number(value).toFixed(2)}`]);
    input.addEventListener("input", () => show(input.value));
    input.addEventListener("change", () => changed({ [name]: Number(input.value) }));
    host.append(element("label", { class: "control" }, element("span", {}, label), input, output));
    return (all) => show(all[name]);
  });
  const showAll = (all) => shows.forEach((show) => show(all));
  showAll(settings);
  return showAll;
}

/** Shows pairs of keys and what they do. */
export function showKeys(host, pairs) {
  const cells = pairs.map(([keys, text]) =>
    element("div", {}, element("dt", {}, ...keys.map((key) => element("kbd", {}, key))), element("dd", {}, text)),
  );
  host.replaceChildren(element("dl", { class: "keys" }, ...cells));
}
