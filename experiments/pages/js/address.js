// The address of a report, which names the episode that is shown: task, seed, episode and perhaps run.

/** @typedef {{ run: number, task: number, seed: number, episode: number }} Place episode counts from 0 */

/** The place that an address names; what it leaves out is 0, or the episode of another place. @type {(hash: string, otherwise: Place) => Place} */
export function placeOf(hash, otherwise) {
  if (!hash) return otherwise;
  const numbers = hash.slice(1).split(",").map(Number);
  const [task, seed, episode, run] = numbers.map((number) => (Number.isInteger(number) ? number : undefined));
  return { task: task ?? 0, seed: seed ?? 0, run: run ?? 0, episode: (episode ?? otherwise.episode + 1) - 1 };
}

/** The address of a place; the first run is not named. @type {(place: Place) => string} */
export const addressOf = ({ run, task, seed, episode }) => `#${task},${seed},${episode + 1}${run ? `,${run}` : ""}`;

/**
 * Put an address into the address bar. Browsers limit how often a page may do so, and throw an error beyond that: the
 * page then goes on with the old address.
 * @param {string} hash
 */
export function writeAddress(hash) {
  if (location.hash === hash) return;
  try {
    history.replaceState(null, "", hash);
  } catch {
    // The page shows the right episode in any case; only the address is that of an earlier one.
  }
}
