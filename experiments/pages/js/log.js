// One adaptation as experiments/pages/report.py packed it.

import { mean, product, range, unpack } from "./arrays.js";

/**
 * @typedef {import("./arrays.js").Packed} Packed
 * @typedef {{ label: string, colors: Record<string, string[]>, facts: [string, string][], comparison: string, note: string, arrays: Packed }} RunData
 * @typedef {{ goals: Goal[], pulls: number, mean: number, isNew: boolean, isChanged: boolean }} ArmRow
 */

/** What an adaptation did: axes S seeds, N tasks, E episodes, R rounds, C judgements. */
export class Log {
  /** @param {RunData} data @param {Record<string, import("./arrays.js").Shaped>} arrays @param {number} [number] that of the run in the page */
  constructor(data, arrays, number = 0) {
    this.data = data;
    this.arrays = arrays;
    this.color = `var(--run-${number})`;
    this.ink = `var(--run-${number}-ink)`; // of text on that color
    const [numSeeds, numTasks, numEpisodes] = arrays.returns.shape;
    this.numSeeds = numSeeds;
    this.numTasks = numTasks;
    this.numEpisodes = numEpisodes;
    this.numJudged = arrays.evalEpisodes.shape[0];
    this.hasPrompts = Boolean(arrays.choice);
    this.hasArms = Boolean(arrays.arm);
    this.hasMap = Boolean(arrays.visits);
    this.hasOrder = Boolean(arrays.prefix);
    this.hasWorths = Boolean(arrays.worthEpisode);
    this.hasActions = Boolean(arrays.actions);
    this.hasTracks = Boolean(arrays.track);
    if (this.hasPrompts) arrays.choice.data = decodeNew(arrays.choice.data);
    this.hasReached = Boolean(arrays.reachedCounts);
    this.actionsFrom = this.hasActions ? sums(arrays.lengths.data) : new Uint32Array(0);
    this.trackStride = this.hasTracks ? arrays.trackStride.data[0] : 0;
    this.trackFrom = this.hasTracks ? sums(arrays.trackCounts.data) : new Uint32Array(0);
    this.waysFrom = this.hasMap ? sums(arrays.wayCounts.data.map((/** @type {number} */ count) => Math.max(count - 1, 0))) : new Uint32Array(0);
    this.reachedFrom = this.hasReached ? sums(arrays.reachedCounts.data) : new Uint32Array(0);
  }

  /** @param {RunData} data @param {number} [number] */
  static async of(data, number) {
    return new Log(data, await unpack(data.arrays), number);
  }

  /** @param {number} seed @param {number} task @param {number} episode */
  at(seed, task, episode) {
    return (seed * this.numTasks + task) * this.numEpisodes + episode;
  }

  /** Return of an episode of the search. @param {number} seed @param {number} task @param {number} episode @returns {number} */
  return_(seed, task, episode) {
    return this.arrays.returns.data[this.at(seed, task, episode)];
  }

  /** @param {number} seed @param {number} task @param {number} judgement @returns {number} */
  judged(seed, task, judgement) {
    return this.arrays.evalReturns.data[(seed * this.numTasks + task) * this.numJudged + judgement];
  }

  /** Mean judged return of a task over the seeds. @param {number} task @param {number} judgement */
  judgedMean(task, judgement) {
    return mean(range(this.numSeeds).map((seed) => this.judged(seed, task, judgement)));
  }

  /** The places of the goals of row `index` of the table of prompts in the table of goals. @param {number} index @returns {number[]} */
  places(index) {
    const { data, shape: [, slots] } = this.arrays.prompts;
    return Array.from(data.slice(index * slots, (index + 1) * slots), (/** @type {number} */ place) => place - 1).filter((place) => place >= 0);
  }

  /** The goals of row `index` of the table of prompts. @param {number} index @returns {Goal[]} */
  prompt(index) {
    const { data, shape: [, size] } = this.arrays.goals;
    return this.places(index).map((place) => data.slice(place * size, (place + 1) * size));
  }

  /** Which goals of a row of the table of prompts are far from the goals of the training. @param {number} index @returns {boolean[]} */
  isFar(index) {
    return this.places(index).map((place) => Boolean(this.arrays.far?.data[place]));
  }

  /** @param {"choice" | "best" | "greedy"} name @param {number} seed @param {number} task @param {number} episode @returns {number} */
  ofRound(name, seed, task, episode) {
    const rounds = this.arrays[name].shape[2];
    const round = Math.floor((episode * rounds) / this.numEpisodes);
    return this.arrays[name].data[(seed * this.numTasks + task) * rounds + round];
  }

  /** The actions of an episode. @param {number} seed @param {number} task @param {number} episode @returns {ArrayLike<number>} */
  actions(seed, task, episode) {
    const at = this.at(seed, task, episode);
    return this.arrays.actions.data.subarray(this.actionsFrom[at], this.actionsFrom[at + 1]);
  }

  /** What the rules need to begin an episode. @param {number} seed @param {number} task @param {number} episode @returns {ArrayLike<number> | null} */
  start(seed, task, episode) {
    const starts = this.arrays.starts;
    if (!starts) return null;
    const size = product(starts.shape.slice(3)), at = this.at(seed, task, episode) * size;
    return starts.data.subarray(at, at + size);
  }

  /** Whether the moments of an episode are known. @param {number} seed @param {number} task @param {number} episode */
  isTracked(seed, task, episode) {
    return this.hasTracks && this.arrays.trackCounts.data[this.at(seed, task, episode)] > 0;
  }

  /** What the drawing has to know of each moment of an episode. @param {number} seed @param {number} task @param {number} episode @returns {number[][]} */
  track(seed, task, episode) {
    const { data, shape: [size, total] } = this.arrays.track, at = this.at(seed, task, episode);
    const row = Array.from({ length: size }, () => 0);
    return range(this.trackFrom[at + 1] - this.trackFrom[at]).map((i) => {
      for (let k = 0; k < size; k++) row[k] = (row[k] + data[k * total + this.trackFrom[at] + i]) % 256;
      return [...row];
    });
  }

  /** Goals that an episode reached, with their steps. @param {number} seed @param {number} task @param {number} episode @returns {{ step: number, goal: Goal }[]} */
  reached(seed, task, episode) {
    const at = this.at(seed, task, episode), { reachedSteps, reachedGoals, goals } = this.arrays, size = goals.shape[1];
    return range(this.reachedFrom[at + 1] - this.reachedFrom[at]).map((i) => {
      const place = this.reachedFrom[at] + i, goal = reachedGoals.data[place];
      return { step: reachedSteps.data[place] + 1, goal: goals.data.slice(goal * size, (goal + 1) * size) };
    });
  }

  /** The goals that a search has found until its end, in this order. @param {number} seed @param {number} task @returns {Goal[]} */
  found(seed, task) {
    const { known, knownGoals } = this.arrays, num = known.shape[2], size = knownGoals.shape[1], at = (seed * this.numTasks + task) * num;
    const places = Array.from(known.data.subarray(at, at + num), (place) => place - 1);
    return places.filter((place) => place >= 0).map((place) => knownGoals.data.slice(place * size, (place + 1) * size));
  }

  /**
   * The map after an episode: its states with their visits, and the shortest known way.
   * @param {number} seed @param {number} task @param {number} episode
   * @returns {{ goals: Goal[], visits: number[], way: Goal[], verified: number }}
   */
  map(seed, task, episode) {
    const { visits, wayCounts, ways, verified } = this.arrays, num = visits.shape[3], goals = this.found(seed, task);
    const counts = goals.map(() => 0);
    /** @type {Goal[]} */
    let way = [];
    for (let e = 0; e <= episode; e++) {
      const at = this.at(seed, task, e);
      for (let i = 0; i < counts.length; i++) counts[i] += visits.data[at * num + i];
      if (wayCounts.data[at]) way = Array.from(ways.data.subarray(this.waysFrom[at], this.waysFrom[at + 1]), (state) => goals[state]);
    }
    const isKnown = (/** @type {any} */ _, /** @type {number} */ i) => counts[i] > 0;
    return { goals: goals.filter(isKnown), visits: counts.filter(isKnown), way, verified: verified.data[this.at(seed, task, episode)] };
  }

  /**
   * What is known of the order after an episode.
   * @param {number} seed @param {number} task @param {number} episode
   * @returns {{ confirmed: Goal[], excluded: Goal[], isComplete: boolean }}
   */
  order(seed, task, episode) {
    const { prefix, excluded, complete } = this.arrays, at = this.at(seed, task, episode), goals = this.found(seed, task);
    const places = prefix.shape[3], row = Array.from(prefix.data.subarray(at * places, (at + 1) * places));
    const out = excluded.data.subarray(at * excluded.shape[3]);
    return {
      confirmed: row.filter((place) => place > 0).map((place) => goals[place - 1]),
      excluded: goals.filter((_, i) => out[i]),
      isComplete: Boolean(complete.data[at]),
    };
  }

  /**
   * The best tried prompts after an episode with the posterior of their mean returns, the best first.
   * @param {number} seed @param {number} task @param {number} episode
   * @returns {{ goals: Goal[], first: number, tries: number, mean: number, std: number }[]}
   */
  worths(seed, task, episode) {
    const { worthEpisode, worthMean, worthStd } = this.arrays, num = worthEpisode.shape[3], at = this.at(seed, task, episode) * num;
    const prompt = (/** @type {number} */ e) => this.ofRound("choice", seed, task, e);
    return range(num).filter((i) => worthEpisode.data[at + i]).map((i) => {
      const first = worthEpisode.data[at + i] - 1, tries = range(episode + 1).filter((e) => prompt(e) === prompt(first)).length;
      return { goals: this.prompt(prompt(first)), first, tries, mean: worthMean.data[at + i], std: worthStd.data[at + i] };
    });
  }

  /** The table of arms after an episode. @param {number} seed @param {number} task @param {number} episode @returns {ArmRow[]} */
  arms(seed, task, episode) {
    /** @type {{ goals: Goal[], returns: number[], since: number }[]} */
    const rows = [];
    let changed = -1;
    for (let e = 0; e <= episode; e++) {
      const at = this.at(seed, task, e), row = this.arrays.arm.data[at];
      changed = row === 255 ? -1 : row;
      if (changed < 0) continue;
      if (this.arrays.pulls.data[at] === 1)
        rows[row] = { goals: this.prompt(this.ofRound("choice", seed, task, e)), returns: [], since: e };
      rows[row].returns.push(this.return_(seed, task, e));
    }
    return rows.map(({ goals, returns, since }, row) => ({
      goals, pulls: returns.length, mean: mean(returns), isNew: since === episode, isChanged: row === changed,
    }));
  }
}

/** Numbers of prompts, of which each new one was written as 0. @type {(coded: ArrayLike<number>) => Uint32Array} */
function decodeNew(coded) {
  let numKnown = 0;
  return Uint32Array.from(coded, (code) => (code ? code - 1 : numKnown++));
}

/** Where the parts begin that have these sizes; the last entry is the end. @type {(sizes: ArrayLike<number>) => Uint32Array} */
function sums(sizes) {
  const from = new Uint32Array(sizes.length + 1);
  for (let i = 0; i < sizes.length; i++) from[i + 1] = from[i] + sizes[i];
  return from;
}
