// Builds elements and icons. Shared by the report's player and the page of rsjax play.

const ICONS = {
  play: "M8 5v14l11-7z",
  pause: "M6 5h4v14H6zM14 5h4v14h-4z",
  back: "M18 6v12l-8.5-6zM6 6h2.5v12H6z",
  forward: "M6 6v12l8.5-6zM15.5 6H18v12h-2.5z",
};

/** Makes an element. Attributes that are functions listen (onclick); null and false leave an attribute out. */
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Makes an element of a drawing. */
export function drawing(tag, attributes = {}, ...children) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

export function icon(name) {
  return drawing("svg", { viewBox: "0 0 24 24", class: "icon", "aria-hidden": "true" }, drawing("path", { d: ICONS[name] }));
}

/** Makes a round button with an icon; its name is for readers of the screen and for the pointer. */
export function iconButton(name, label, onclick) {
  return element("button", { type: "button", class: "round", "aria-label": label, title: label, onclick }, icon(name));
}

/** Returns whether a key typed at this element is the element's own: text is typed there, or it moves by arrows. */
export function takesKeys(target) {
  return target instanceof Element && target.closest("input, select, textarea, [contenteditable], dialog") !== null;
}
