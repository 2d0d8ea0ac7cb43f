// One world of the playground: its policy, its task, the episode in progress, and the search for a prompt.

import { argmax } from "./decoder.js";
import { Chance, Search, runEpisode, sampled } from "./search.js";

/**
 * @typedef {{ name: string, summary: string, facts: any, tasks: { task: any, text: string }[], network: import("./decoder.js").Network,
 *   weights: import("./arrays.js").Packed, seen: import("./seen.js").SeenData | null, sha256: string, returnSpan: number, deterministic: boolean, keepRewarded: boolean }} WorldData
 * @typedef {{ returns: number[], goals: Goal[], moments: any[] }} Progress returns: of the best prompt after each episode; the others are of the last episode
 */

const CHANCE = new Chance();

/** One world with its policy, its task and the episode in progress. */
export class Stage {
  /** @param {WorldPage} world @param {WorldData} data @param {import("./decoder.js").Policy} policy @param {(goal: Goal) => boolean} isFar */
  constructor(world, data, policy, isFar) {
    this.world = world;
    this.data = data;
    this.policy = policy;
    this.isFar = isFar;
    /** @type {Goal[]} */
    this.waypoints = [];
    /** @type {any} */
    this.task = data.tasks[0].task;
    /** @type {any[]} */
    this.moments = [];
    /** @type {Spot} */
    this.cursor = { row: 0, column: 0 };
    this.play = world.play(data.facts, this.task);
    /** @type {Float32Array} */
    this.logits = new Float32Array(data.network.action_dim);
    this.restart();
  }

  get goals() {
    return [...this.waypoints, this.world.taskGoal(this.data.facts, this.task)];
  }

  /** Room for further goals before the task goal. */
  get hasRoom() {
    return this.waypoints.length < this.data.network.max_prompt_length - 1;
  }

  /** The best return of any policy on the present task, or NaN. */
  get optimum() {
    return this.world.optimum(this.data.facts, this.task);
  }

  /** @param {any} task */
  take(task) {
    this.task = task;
    this.restart();
  }

  restart() {
    this.play = this.world.play(this.data.facts, this.task);
    const timestep = this.play.reset(null);
    this.moments = [this.play.moment()];
    this.policy.begin(this.goals);
    this.logits = this.policy.observe(timestep.obs);
  }

  /** @param {boolean} samples */
  step(samples) {
    if (this.play.done) return;
    const action = samples ? sampled(this.logits, CHANCE) : argmax(this.logits);
    const timestep = this.play.step(action);
    this.moments.push(this.play.moment());
    if (this.play.done) return;
    this.policy.act(action);
    this.logits = this.policy.observe(timestep.obs);
  }

  /** What is at a spot, in words. @param {Spot} spot */
  tellSpot(spot) {
    const { world, data: { facts }, task } = this, wanted = world.goalAt(facts, task, spot);
    const place = wanted ? this.waypoints.findIndex((goal) => goal.every((value, i) => value === wanted[i])) : -1;
    const there = [world.tellSpot?.(facts, task, spot), place >= 0 && `goal ${place + 1} of the prompt`].filter(Boolean);
    return `Row ${spot.row}, column ${spot.column}${there.length ? `: ${there.join(", ")}` : ""}`;
  }

  /**
   * Search with UCB for a prompt for the present task.
   *
   * The search acts with the policy of this stage and overwrites what the policy remembers. However it ends, the
   * episode of the stage begins again, so that the policy next acts on what the page shows.
   * @param {number} numEpisodes @param {(progress: Progress) => Promise<boolean>} goesOn is told of every episode, and says whether the search goes on
   * @returns {Promise<{ returns: number[], prompt: Goal[] }>} prompt: the best one
   */
  async search(numEpisodes, goesOn) {
    const { data, world, task, policy } = this;
    const search = new Search({
      numSlots: data.network.max_prompt_length, numEpisodes, returnSpan: data.returnSpan,
      deterministic: data.deterministic, keepRewarded: data.keepRewarded,
    }, world.taskGoal(data.facts, task), CHANCE);
    /** @type {number[]} */
    const returns = [];
    try {
      let isOn = true;
      while (isOn && returns.length < numEpisodes) {
        const { goals, isGreedy } = search.ask();
        const episode = runEpisode(policy, world.play(data.facts, task), goals, isGreedy, CHANCE);
        search.tell(goals, episode);
        const best = search.best();
        returns.push(data.deterministic ? best.entry : best.mean);
        isOn = await goesOn({ returns, goals, moments: episode.moments });
      }
    } finally {
      this.restart();
    }
    return { returns, prompt: search.best().prompt };
  }
}
