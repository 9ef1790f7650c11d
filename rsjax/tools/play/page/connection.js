// The socket: numbered messages with one answer each, frames, and coming back after a lost connection.

const HEADER = 24; // bytes
const FINAL = new Set([4401, 4403, 4408, 4409, 4429, 1008]);
const LONGEST_WAIT = 10_000; // milliseconds between attempts to connect again
export const KINDS = { 1: "rgb", 2: "depth", 3: "truth", 4: "truth_depth", 5: "uncertainty" };
const TYPES = { 1: "image/jpeg", 2: "image/webp", 3: "image/png" };

/** Returns an address of the server with the token of this page's own. */
export function address(path, fields = {}) {
  const url = new URL(path, location.origin);
  const token = new URLSearchParams(location.search).get("token");
  for (const [name, value] of Object.entries({ token, ...fields })) if (value) url.searchParams.set(name, value);
  return url;
}

/** Reads a binary message. */
export function parseFrame(buffer) {
  const view = new DataView(buffer);
  const format = view.getUint8(12);
  const data = buffer.slice(HEADER);
  return {
    kind: KINDS[view.getUint8(1)],
    branch: view.getUint16(2, true),
    frame: view.getUint32(4, true),
    id: view.getUint32(8, true),
    width: view.getUint16(14, true),
    height: view.getUint16(16, true),
    scale: view.getFloat32(20, true),
    data: format === 0 ? new Uint8Array(data) : new Blob([data], { type: TYPES[format] }),
  };
}

/**
 * Opens the socket and keeps it open.
 * @param session returns the session to come back to, or null.
 * @param on functions: message(data) of messages that answer nothing, frame(frame), open(),
 *   lost(wait in milliseconds), closed(code, reason) when no further attempt is made.
 */
export function connect({ session, on }) {
  let socket = null;
  let next = 1;
  let tries = 0;
  let timer = 0;
  const waiting = new Map();

  function open() {
    clearTimeout(timer);
    if (socket) {
      socket.onclose = socket.onmessage = null;
      socket.close();
      rejectWaiting();
    }
    const url = address("/ws", { session: session() });
    url.protocol = url.protocol.replace("http", "ws");
    socket = new WebSocket(url);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => (typeof data === "string" ? receive(JSON.parse(data)) : on.frame(parseFrame(data)));
    socket.onclose = ({ code, reason }) => close(code, reason);
  }

  function receive(message) {
    if (message.type === "welcome") {
      tries = 0;
      on.open(message);
      return;
    }
    const answer = message.id > 0 || message.type === "uploaded" || message.error === "bad_image" ? message.id : -1;
    const call = message.type === "progress" ? null : waiting.get(answer);
    if (!call) {
      on.message(message);
      return;
    }
    waiting.delete(answer);
    if (message.type === "error") call.reject(Object.assign(new Error(message.message), { code: message.error }));
    else call.resolve(message);
  }

  function rejectWaiting() {
    for (const { reject } of waiting.values()) reject(Object.assign(new Error("the connection was lost"), { code: "lost" }));
    waiting.clear();
  }

  function close(code, reason) {
    rejectWaiting();
    if (FINAL.has(code)) {
      on.closed(code, reason);
      return;
    }
    const wait = Math.min(LONGEST_WAIT, 500 * 2 ** tries++);
    on.lost(wait);
    timer = setTimeout(open, wait);
  }

  function ask(id, data) {
    return new Promise((resolve, reject) => {
      if (socket?.readyState !== WebSocket.OPEN) {
        reject(Object.assign(new Error("there is no connection"), { code: "lost" }));
        return;
      }
      waiting.set(id, { resolve, reject });
      socket.send(data);
    });
  }

  /** Sends a message; returns a promise of its answer, with the message's number as `id`. */
  function call(type, fields = {}) {
    const id = next++;
    const promise = ask(id, JSON.stringify({ type, id, ...fields }));
    promise.id = id;
    return promise;
  }

  /** Sends a picture. */
  function upload(blob) {
    return ask(0, blob);
  }

  open();
  return { call, upload, again: open, drop: () => socket.close() };
}
