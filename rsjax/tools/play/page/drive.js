// The stick: keys, a gamepad, sliders and a pad, which together set one control vector.
import { element, takesKeys } from "./player/dom.js";

// Two keys for each axis in the order of the robot's controls; the first one goes towards its greatest value.
const AXIS_KEYS = [["KeyW", "KeyS"], ["KeyA", "KeyD"], ["KeyR", "KeyF"], ["KeyI", "KeyK"], ["KeyJ", "KeyL"], ["KeyU", "KeyO"]];
const TOGGLE_KEYS = ["KeyG", "KeyH"];
// The gamepad's axes: the left stick moves the first two controls, the right one the third and the last.
const GAMEPAD_AXES = [[1, 0], [0, 1], [3, 2], [2, 5]].map(([axis, control]) => ({ axis, control }));
const DEAD = 0.12; // share of a stick's way that counts as rest
const STEPS = 200; // of a slider
const GENTLE = 0.4; // of the way, with Shift

function letter(code) {
  return code.slice(3);
}

/**
 * Makes the stick of a robot.
 * @param controls the robot's controls, as in the server's welcome.
 * @param facing whether the camera looks the robot in the face: then its left is the picture's right, and keys, pad and
 *   gamepad move the first two axes as the picture shows it.
 * @param changed called with the time of an event that changed the vector.
 */
export function makeStick({ controls, facing, host, switches, pad, changed }) {
  const turned = facing ? -1 : 1;
  const down = new Set();
  const tapped = new Set(); // pressed since the last step, which a short tap must not miss
  const axes = controls.flatMap((each, place) => (each.kind === "axis" ? [place] : []));
  const toggles = controls.flatMap((each, place) => (each.kind === "toggle" ? [place] : []));
  const sliders = controls.map((each) => each.rest); // set by sliders and switches
  const tilt = controls.map(() => 0); // -1 … 1, by the pad
  const gamepad = controls.map(() => 0);
  let pressed = false;
  const rows = controls.map((each, place) => (each.kind === "axis" ? axisRow(each, place) : toggleRow(each, place)));
  host.replaceChildren(...axes.map((place) => rows[place].row));
  switches.replaceChildren(...toggles.map((place) => rows[place].row));

  function keysOf(place) {
    const number = axes.indexOf(place);
    const [more, less] = AXIS_KEYS[number] ?? [];
    return more === undefined ? [] : facing && number < 2 ? [less, more] : [more, less];
  }

  function axisRow(control, place) {
    const step = (control.high - control.low) / STEPS;
    const input = element("input", { type: "range", min: control.low, max: control.high, step, value: control.rest });
    const output = element("output", {});
    const keys = keysOf(place).map((code) => element("kbd", {}, letter(code)));
    const row = element("label", { class: "control" }, element("span", {}, control.label, " ", ...keys), input, output);
    input.addEventListener("input", (event) => {
      sliders[place] = Number(input.value);
      update(event.timeStamp);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      input.addEventListener(end, (event) => {
        sliders[place] = control.rest;
        update(event.timeStamp);
      });
    }
    return { row, show: (value) => showAxis(control, input, output, value) };
  }

  function toggleRow(control, place) {
    const code = TOGGLE_KEYS[toggles.indexOf(place)];
    const key = code ? [" ", element("kbd", {}, letter(code))] : [];
    const button = element("button", { type: "button", role: "switch", class: "switch", onclick: ({ timeStamp }) => flip(place, timeStamp) });
    const [name, ...words] = control.label.split(/[:,] /); // "gripper: open, closed"
    const row = element("div", { class: "control" }, element("span", {}, name, ...key), button);
    button.setAttribute("aria-label", words[1] ? `${name} ${words[1]}` : name);
    return {
      row,
      show(value) {
        const on = value === control.high;
        button.setAttribute("aria-checked", on);
        button.textContent = words[Number(on)] ?? (on ? "on" : "off");
      },
    };
  }

  function flip(place, time) {
    const { low, high } = controls[place];
    sliders[place] = sliders[place] === high ? low : high;
    update(time);
  }

  /** Returns the control vector as it stands. */
  function vector() {
    return controls.map((control, place) => {
      if (control.kind === "toggle") return sliders[place];
      const [more, less] = keysOf(place);
      const held = (code) => down.has(code) || tapped.has(code);
      const fine = held("ShiftLeft") || held("ShiftRight") ? GENTLE : 1;
      const push = fine * (held(more) - held(less)) + tilt[place] + gamepad[place];
      const way = push > 0 ? control.high - control.rest : control.rest - control.low;
      return Math.max(control.low, Math.min(control.high, sliders[place] + push * way));
    });
  }

  /** Returns the control vector for a step. */
  function take() {
    const now = vector();
    tapped.clear();
    if (!down.size) rows.forEach(({ show }, place) => show(vector()[place]));
    return now;
  }

  /** Returns whether an axis is away from its rest. */
  function driving() {
    return vector().some((value, place) => controls[place].kind === "axis" && Math.abs(value - controls[place].rest) > 1e-6);
  }

  function update(time) {
    const now = vector();
    rows.forEach(({ show }, place) => show(now[place]));
    changed(time);
  }

  function rest(time = performance.now()) {
    down.clear();
    tapped.clear();
    for (const place of axes) [sliders[place], tilt[place], gamepad[place]] = [controls[place].rest, 0, 0];
    update(time);
  }

  /** Acts on a key; returns whether it was one of the stick's. */
  function key(event) {
    const { code, type, repeat, timeStamp } = event;
    const held = code.startsWith("Shift") || axes.some((place) => keysOf(place).includes(code));
    const toggle = toggles[TOGGLE_KEYS.indexOf(code)];
    if (type === "keyup") {
      if (down.delete(code)) update(timeStamp);
      return false;
    }
    if (event.ctrlKey || event.metaKey || event.altKey || (!held && toggle === undefined && code !== "KeyX")) return false;
    if (repeat) return true;
    if (held) [down, tapped].forEach((keys) => keys.add(code));
    else if (code === "KeyX") rest(timeStamp);
    else flip(toggle, timeStamp);
    if (held || toggle !== undefined) update(timeStamp);
    return !code.startsWith("Shift");
  }

  function tiltPad(event) {
    const box = pad.getBoundingClientRect();
    const place = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    const [x, y] = place.map((share) => Math.max(-1, Math.min(1, 2.4 * (share - 0.5))));
    setPad(pressed ? -x * turned : 0, pressed ? -y * turned : 0, event.timeStamp);
  }

  function setPad(second, first, time) {
    if (axes.length < 2) return;
    [tilt[axes[0]], tilt[axes[1]]] = [first, second];
    pad.firstElementChild.style.transform = `translate(${-turned * second * 90}%, ${-turned * first * 90}%)`;
    update(time);
  }

  /** Reads the first gamepad, if there is one; to be called once for each picture of the screen. */
  function poll() {
    const found = [...(navigator.getGamepads?.() ?? [])].find(Boolean);
    if (!found) return false;
    const before = gamepad.join();
    for (const { axis, control } of GAMEPAD_AXES) {
      const tilted = found.axes[axis] ?? 0;
      if (control < axes.length) gamepad[axes[control]] = Math.abs(tilted) > DEAD ? -tilted * (control < 2 ? turned : 1) : 0;
    }
    const button = found.buttons[0]?.pressed ?? false;
    if (button && !poll.held && toggles.length) flip(toggles[0], performance.now());
    poll.held = button;
    if (gamepad.join() !== before) update(performance.now());
    return true;
  }

  pad.onpointerdown = (event) => {
    pressed = true;
    pad.setPointerCapture(event.pointerId);
    tiltPad(event);
  };
  pad.onpointermove = (event) => pressed && tiltPad(event);
  pad.onpointerup = pad.onpointercancel = (event) => {
    pressed = false;
    setPad(0, 0, event.timeStamp);
  };
  pad.hidden = axes.length < 2;
  update(performance.now());
  return { take, driving, rest, key, poll, keys: keyList(controls, keysOf, toggles) };
}

function showAxis(control, input, output, value) {
  input.value = value;
  const text = amount(control, value);
  output.textContent = text;
  input.setAttribute("aria-valuetext", text);
}

/** Returns a control's value in the robot's own unit, for one control step. */
function amount({ scale, unit, rest }, value) {
  const by = (value - rest) * (scale ?? 1);
  const sign = by > 0 ? "+" : by < 0 ? "−" : "";
  const size = Math.abs(by);
  if (scale && /^met(re|er)s?$/.test(unit)) return `${sign}${(1000 * size).toFixed(1)} mm`;
  if (scale && /^radians?$/.test(unit)) return `${sign}${((180 * size) / Math.PI).toFixed(1)}°`;
  return `${sign}${size.toFixed(2)} ${scale ? unit : ""}`.trim();
}

function keyList(controls, keysOf, toggles) {
  return controls.flatMap(({ label, kind }, place) => {
    const keys = kind === "axis" ? keysOf(place) : [TOGGLE_KEYS[toggles.indexOf(place)]].filter(Boolean);
    return keys.length ? [[keys.map(letter), label]] : [];
  });
}

/** Returns whether an element keeps this key for itself: letters belong to the stick, except where text is typed. */
export function keepsKey({ target, code }) {
  if (!takesKeys(target)) return target.closest?.("button, summary, a") && ["Space", "Enter"].includes(code);
  if (target.closest("dialog")) return true;
  return !target.matches("input[type=range], input[type=checkbox], select") || !/^(Key|Digit|Shift)/.test(code);
}
