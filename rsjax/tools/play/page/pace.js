// When the next step is sent, and how long its picture takes.

const FAR = 20; // milliseconds of a round trip above which two steps are on their way
const LAST = 200; // latencies of which quantiles are shown
const WINDOW = 3000; // milliseconds over which frames are counted

/**
 * Makes the pump of steps.
 * @param wants returns whether a frame is wanted now.
 * @param send sends one step and returns the promise of its answer, which has the message's `id`.
 * @param rate returns the most frames a second.
 * @param failed called with the error of a step.
 */
export function makePace({ wants, send, rate, failed }) {
  const flying = new Map(); // id → time of the key that it answers, or null
  const latencies = [];
  const shown = [];
  let trip = 0;
  let touched = null; // time of the last key that no step has carried yet
  let last = 0;
  let timer = 0;

  function pump() {
    clearTimeout(timer);
    while (flying.size < (trip > FAR ? 2 : 1) && wants()) {
      const now = performance.now();
      const wait = last + 1000 / rate() - now;
      if (wait > 1) {
        timer = setTimeout(pump, wait);
        return;
      }
      last = now;
      step();
    }
  }

  function step() {
    const answer = send();
    flying.set(answer.id, touched);
    touched = null;
    answer.catch((error) => {
      flying.delete(answer.id);
      failed(error);
    });
  }

  /** Call when a step's picture has come; then pump, before it is drawn. Returns the time of its key, null or undefined. */
  function arrived(id) {
    const key = flying.get(id);
    flying.delete(id);
    return key;
  }

  /** Call when the screen shows the picture of a step, and perhaps of some before it, with the times of their keys. */
  function drawn(keys) {
    const now = performance.now();
    shown.push(now);
    while (shown.length && now - shown[0] > WINDOW) shown.shift();
    for (const key of keys) if (key) latencies.push(now - key);
    while (latencies.length > LAST) latencies.shift();
  }

  function touch(time) {
    touched ??= time;
    pump();
  }

  /** Returns frames a second, and quantiles of the milliseconds from key to picture. */
  function figures() {
    const now = performance.now();
    const recent = shown.filter((time) => now - time <= WINDOW);
    const span = recent.length > 1 ? recent.at(-1) - recent[0] : 0;
    const sorted = [...latencies].sort((one, two) => one - two);
    const quantile = (share) => sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
    return { rate: span ? (1000 * (recent.length - 1)) / span : 0, p50: quantile(0.5), p95: quantile(0.95), count: sorted.length };
  }

  return {
    pump, step, arrived, drawn, touch, figures,
    setTrip: (milliseconds) => (trip = milliseconds),
    reset: () => flying.clear(),
    clear: () => ([latencies.length, shown.length] = [0, 0]),
    flying: () => flying.size,
  };
}
