// Prompt optimization in the page: Algorithm 1 with UCB, as mgpo_jax/optimizers/arms.py, ucb.py and mgpo_jax/prompts.py
// have it. Returns and their means are in single precision there, and so they are here.

import { argmax } from "./decoder.js";

/**
 * @typedef {{ numSlots: number, numEpisodes: number, returnSpan: number, deterministic: boolean,
 *   keepRewarded: boolean }} Space
 * @typedef {{ achieved: Goal[], reached: boolean[], outcomes: Goal[], rewards: number[], actions: number[],
 *   moments: any[], return_: number }} Episode
 * @typedef {{ prompt: Goal[], pulls: number, mean: number, entry: number }} Arm
 */

const MAX_ARMS = 64;
const SHRINKAGE = 2;
const { fround } = Math;

/** Where random numbers come from. A test gives those of JAX instead. */
export class Chance {
  /** @param {() => number} random */
  constructor(random = Math.random) {
    this.random = random;
  }

  /** A whole number from low to below high. @param {number} low @param {number} high */
  integer(low, high) {
    return low + Math.floor(this.random() * (high - low));
  }

  /** @param {number} num @returns {ArrayLike<number>} */
  uniforms(num) {
    return Float64Array.from({ length: num }, this.random);
  }

  /** Noise that makes the argmax of logits a sample. @param {number} num @returns {ArrayLike<number>} */
  gumbels(num) {
    return Float64Array.from({ length: num }, () => -Math.log(-Math.log(this.random() || 1e-12)));
  }

  /** What an episode starts with; null leaves it to the rules. @returns {ArrayLike<number> | null} */
  start() {
    return null;
  }
}

/**
 * An episode of a policy under a prompt.
 * @param {import("./decoder.js").Policy} policy @param {Play} play @param {Goal[]} goals @param {boolean} isGreedy
 * @param {Chance} chance @returns {Episode}
 */
export function runEpisode(policy, play, goals, isGreedy, chance) {
  let timestep = play.reset(chance.start());
  /** @type {Episode} */
  const episode = { achieved: [], reached: [], outcomes: [], rewards: [], actions: [], moments: [play.moment()], return_: 0 };
  policy.begin(goals);
  while (!play.done) {
    const logits = policy.observe(timestep.obs);
    const action = isGreedy ? argmax(logits) : sampled(logits, chance);
    policy.act(action);
    timestep = play.step(action);
    episode.achieved.push(timestep.achieved);
    episode.reached.push(timestep.reached);
    episode.outcomes.push(timestep.outcome);
    episode.rewards.push(timestep.reward);
    episode.actions.push(action);
    episode.moments.push(play.moment());
  }
  return { ...episode, return_: play.return_ };
}

/** @type {(logits: Float32Array, chance: Chance) => number} */
export function sampled(logits, chance) {
  const noise = chance.gumbels(logits.length);
  return argmax(logits.map((value, i) => value + noise[i]));
}

/** @type {(a: Goal, b: Goal) => boolean} */
const isEqual = (a, b) => a.every((value, i) => value === b[i]);

/** Draw a prompt from an episode; `sample_prompt`. @type {(chance: Chance, best: Best, taskGoal: Goal, space: Space) => Goal[]} */
function samplePrompt(chance, { achieved, reached, outcomes, confirmed, length }, taskGoal, space) {
  // The step that reaches the final goal would only repeat it.
  const eligible = reached.map((isReached, t) =>
    isReached && t < length && !(t === length - 1 && isEqual(achieved[t], outcomes[t])));
  const kept = confirmed.map((isKept, t) => isKept && eligible[t]);
  const count = (/** @type {boolean[]} */ which) => which.filter(Boolean).length;
  const most = Math.min(space.numSlots - 1, count(eligible));
  const number = space.keepRewarded
    ? chance.integer(Math.min(count(kept), most), most + 1)
    : Math.min(chance.integer(0, space.numSlots), count(eligible));
  const uniforms = chance.uniforms(eligible.length);
  const score = (/** @type {number} */ t) => (space.keepRewarded && kept[t] ? 2 : eligible[t] ? uniforms[t] : -1);
  const drawn = [...eligible.keys()].sort((a, b) => score(b) - score(a) || a - b).slice(0, number);
  // Those after the last kept step stay as they were drawn: at random.
  const lastKept = space.keepRewarded ? kept.lastIndexOf(true) : eligible.length;
  const place = (/** @type {number} */ t) => (t > lastKept ? eligible.length + drawn.indexOf(t) : t);
  const ordered = [...drawn].sort((a, b) => place(a) - place(b));
  return [...ordered.map((t) => achieved[t]), taskGoal];
}

/**
 * The goals of the best episode so far.
 * @typedef {{ achieved: Goal[], reached: boolean[], outcomes: Goal[], confirmed: boolean[], length: number, return_: number }} Best
 */

/** An episode as the best one, which counts until it has reached the task goal. @type {(episode: Episode, taskGoal: Goal) => Best} */
function asBest({ achieved, reached, outcomes, rewards, return_ }, taskGoal) {
  const end = outcomes.findIndex((outcome) => isEqual(outcome, taskGoal));
  const confirmed = reached.map((isReached, t) => isReached && rewards[t] > 0);
  return { achieved, reached, outcomes, confirmed, length: end < 0 ? achieved.length : end + 1, return_ };
}

/** UCB on one task: ask for a prompt, run an episode, tell it. */
export class Search {
  /** @param {Space} space @param {Goal} taskGoal @param {Chance} chance */
  constructor(space, taskGoal, chance) {
    this.space = space;
    this.taskGoal = taskGoal;
    this.chance = chance;
    this.numTold = 0;
    this.chosen = 0;
    /** @type {Arm[]} */
    this.arms = [];
    /** @type {Best} */
    this.bestEpisode = { achieved: [], reached: [], outcomes: [], confirmed: [], length: 0, return_: -Infinity };
  }

  /** Who acts in the next episode. */
  ask() {
    const { space } = this, acts = this.numTold % 2 === 1;
    if (acts) {
      this.chosen = argmax(this.bounds());
      return { goals: this.arms[this.chosen].prompt, isGreedy: false };
    }
    const isFirst = this.numTold === 0;
    const goals = isFirst ? [this.taskGoal] : samplePrompt(this.chance, this.bestEpisode, this.taskGoal, space);
    return { goals, isGreedy: isFirst || space.deterministic };
  }

  /** Upper confidence bounds of the arms (Eq. 3), in units of the span of returns. */
  bounds() {
    const total = this.arms.reduce((sum, { pulls }) => sum + pulls, 0);
    return this.arms.map(({ mean, pulls }) =>
      fround(mean + fround(this.space.returnSpan * fround(Math.sqrt(fround(fround(Math.log(total)) / (2 * pulls)))))));
  }

  /** @param {Goal[]} goals @param {Episode} episode */
  tell(goals, episode) {
    const acted = this.numTold % 2 === 1, { return_ } = episode;
    if (acted) {
      const arm = this.arms[this.chosen];
      arm.pulls++;
      arm.mean = fround(arm.mean + fround(fround(return_ - arm.mean) / arm.pulls));
    } else if (this.arms.every(({ mean }) => return_ > mean)) {
      const arm = { prompt: goals, pulls: 1, mean: return_, entry: return_ };
      const most = Math.min(MAX_ARMS, 1 + Math.floor(this.space.numEpisodes / 2));
      if (this.arms.length < most) this.arms.push(arm);
      else this.arms[argmax(this.arms.map(({ entry }) => -entry))] = arm;
    }
    if (return_ >= this.bestEpisode.return_) this.bestEpisode = asBest(episode, this.taskGoal);
    this.numTold++;
  }

  /** The best arm so far. */
  best() {
    if (this.space.deterministic) return this.arms[argmax(this.arms.map(({ entry }) => entry))];
    const pulls = this.arms.reduce((sum, arm) => sum + arm.pulls, 0);
    const overall = this.arms.reduce((sum, arm) => sum + arm.pulls * arm.mean, 0) / pulls;
    const shrunk = this.arms.map((arm) => (arm.pulls * arm.mean + SHRINKAGE * overall) / (arm.pulls + SHRINKAGE));
    return this.arms[argmax(shrunk)];
  }
}
