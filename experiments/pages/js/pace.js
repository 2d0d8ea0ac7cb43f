// How often something is said or written, however often it changes.

/**
 * A function that passes values on, at most one in each pause: the first at once, and the last of those that came
 * during the pause when the pause is over.
 * @template T
 * @param {(value: T) => void} act @param {number} pause milliseconds @returns {(value: T) => void}
 */
export function paced(act, pause) {
  let isPausing = false;
  /** @type {T[]} the value that waits, if any */
  let waiting = [];
  const pass = (/** @type {T} */ value) => {
    isPausing = true;
    act(value);
    setTimeout(() => {
      isPausing = false;
      const [last] = waiting;
      if (!waiting.length) return;
      waiting = [];
      pass(last);
    }, pause);
  };
  return (value) => {
    if (isPausing) waiting = [value];
    else pass(value);
  };
}

/**
 * A function that passes a value on once no other one has come for a while.
 * @template T
 * @param {(value: T) => void} act @param {number} pause milliseconds @returns {(value: T) => void}
 */
export function settled(act, pause) {
  /** @type {any} */
  let timer = 0;
  return (value) => {
    clearTimeout(timer);
    timer = setTimeout(() => act(value), pause);
  };
}

/**
 * A function that says texts through a live region of the page, so that a screen reader reads them aloud. It leaves
 * out texts that change faster than anyone can listen.
 * @param {Element} region @returns {(text: string) => void}
 */
export const announcer = (region) => paced((/** @type {string} */ text) => {
  if (region.textContent !== text) region.textContent = text;
}, 1200);
