// Checks the page against JAX: runs under node, or in a page that has it as its entry. It is in no other page.

import { unpack } from "./arrays.js";
import { Policy } from "./decoder.js";
import { Chance, Search, runEpisode } from "./search.js";

/**
 * @typedef {{ task: any, goals: number[][], start: number[] | null, actions: number[] }} Case
 * @typedef {{ task: any, starts: (number[] | null)[], integers: number[][][], uniforms: number[][],
 *   gumbels: number[][][] }} Drawn
 */

/** Random numbers that JAX drew, episode by episode. */
class Given extends Chance {
  /** @param {Drawn} drawn */
  constructor(drawn) {
    super();
    this.drawn = drawn;
    this.episode = this.numActions = 0;
  }

  /** @param {number} low @param {number} high */
  integer(low, high) {
    return this.drawn.integers[this.episode][low][high];
  }

  /** @param {number} num */
  uniforms(num) {
    return this.drawn.uniforms[this.episode].slice(0, num);
  }

  gumbels() {
    return this.drawn.gumbels[this.episode][this.numActions++];
  }

  start() {
    return this.drawn.starts[this.episode];
  }

  next() {
    this.episode++;
    this.numActions = 0;
  }
}

/**
 * Logits along given actions, and the page's own greedy path.
 * @param {WorldPage} world @param {any} facts @param {Policy} policy @param {Case} given
 */
function follow(world, facts, policy, { task, goals, start, actions }) {
  const prompt = goals.map((goal) => Float32Array.from(goal));
  const play = world.play(facts, task);
  let timestep = play.reset(start);
  policy.begin(prompt);
  const logits = actions.map((action) => {
    const row = Array.from(policy.observe(timestep.obs));
    policy.act(action);
    timestep = play.step(action);
    return row;
  });
  const chance = new Chance();
  chance.start = () => start;
  return { logits, done: play.done, return_: play.return_, own: runEpisode(policy, world.play(facts, task), prompt, true, chance).actions };
}

/** A search with given random numbers. @param {WorldPage} world @param {any} data @param {Policy} policy @param {Drawn} drawn */
function searched(world, data, policy, drawn) {
  const chance = new Given(drawn);
  const space = {
    numSlots: data.network.max_prompt_length,
    numEpisodes: drawn.starts.length,
    returnSpan: data.returnSpan,
    deterministic: data.deterministic,
    keepRewarded: data.keepRewarded,
  };
  const search = new Search(space, world.taskGoal(data.facts, drawn.task), chance);
  const episodes = drawn.starts.map(() => {
    const { goals, isGreedy } = search.ask();
    const episode = runEpisode(policy, world.play(data.facts, drawn.task), goals, isGreedy, chance);
    search.tell(goals, episode);
    chance.next();
    return { goals: goals.map((goal) => Array.from(goal)), return_: episode.return_, actions: episode.actions };
  });
  return { episodes, best: search.best().prompt.map((goal) => Array.from(goal)) };
}

/** @param {WorldPage[]} worlds @param {any} data */
export async function check(worlds, data) {
  const [of] = data.worlds;
  const policy = new Policy(of.network, await unpack(of.weights));
  const begun = Date.now();
  const cases = (data.cases ?? []).map((/** @type {Case} */ given) => follow(worlds[0], of.facts, policy, given));
  const seconds = (Date.now() - begun) / 1000;
  const searches = (data.searches ?? []).map((/** @type {Drawn} */ drawn) => searched(worlds[0], of, policy, drawn));
  const replays = (data.replays ?? []).map((/** @type {Case} */ { task, start, actions }) => {
    const play = worlds[0].play(of.facts, task);
    play.reset(start);
    actions.forEach((action) => play.step(action));
    return { return_: play.return_, done: play.done };
  });
  return { cases, searches, replays, seconds };
}

/** In a browser: leave the findings in the document. @param {WorldPage[]} worlds @param {any} data */
export async function main(worlds, data) {
  const result = document.createElement("pre");
  result.id = "result";
  result.textContent = JSON.stringify(await check(worlds, data));
  document.body.append(result);
}
