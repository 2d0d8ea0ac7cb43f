// Goals that a policy was trained on (mgpo_jax/seen_goals.py), and goals far from all of those.

import { range, unpack } from "./arrays.js";

/** @typedef {{ goals: import("./arrays.js").Packed, reach: number }} SeenData */

/** Says of a goal whether it is far; nothing is, where the goals of the training are not known. @type {(seen: SeenData | null) => Promise<(goal: Goal) => boolean>} */
export async function farFrom(seen) {
  if (!seen) return () => false;
  const { data, shape: [num, size] } = (await unpack(seen.goals)).goals;
  const distance = (/** @type {Goal} */ goal, /** @type {number} */ row) => Math.hypot(...range(size).map((i) => goal[i] - data[row * size + i]));
  return (goal) => range(num).every((row) => distance(goal, row) > seen.reach);
}
