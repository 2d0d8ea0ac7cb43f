// The playground: anyone guides a frozen policy by clicking goals, and UCB finds prompts in the page.

import { unpack } from "./arrays.js";
import { curves } from "./chart.js";
import { Policy, argmax, softmax } from "./decoder.js";
import { byId, drawScene, element, fill, legendOf, onScheme, showPrompt, spotAt } from "./dom.js";
import { Chance, Search, runEpisode, sampled } from "./search.js";
import { farFrom } from "./seen.js";

/**
 * @typedef {{ name: string, summary: string, facts: any, tasks: { task: any, text: string }[], network: import("./decoder.js").Network,
 *   weights: import("./arrays.js").Packed, seen: import("./seen.js").SeenData | null, sha256: string, returnSpan: number, deterministic: boolean, keepRewarded: boolean }} WorldData
 */

const NUM_EPISODES = 100;
const PAUSES = [900, 450, 220, 100, 40, 0]; // milliseconds between steps, by speed
const CHANCE = new Chance();

/** Lets the page answer before a long computation goes on. */
const breathe = () => new Promise((resolve) => setTimeout(resolve));

/** One world with its policy, its task and the episode in progress. */
class Stage {
  /** @param {WorldPage} world @param {WorldData} data @param {Policy} policy @param {(goal: Goal) => boolean} isFar */
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
}

class Playground {
  /** @param {string[]} names @param {(world: number) => Promise<Stage>} stageOf builds a stage, which takes a moment */
  constructor(names, stageOf) {
    this.names = names;
    this.stageOf = stageOf;
    /** @type {Map<number, Stage>} */
    this.stages = new Map();
    this.stage = /** @type {Stage} */ (/** @type {unknown} */ (null)); // set by ``choose``
    this.mode = -1; // sets goals; else the number of an edit of the world
    this.timer = 0;
    this.searching = false;
    /** @type {boolean | null} */
    this.painted = null;
    this.hasFocus = false;
  }

  get facts() {
    return this.stage.data.facts;
  }

  async begin() {
    fill(byId("worlds"), ...(this.names.length > 1 ? this.names : []).map((name, i) =>
      element("button", { "data-world": name, onclick: () => this.choose(i) }, name)));
    await this.choose(0);
    const listen = (/** @type {string} */ id, /** @type {string} */ type, /** @type {(event: any) => void} */ act) =>
      byId(id).addEventListener(type, act);
    listen("play", "click", () => this.togglePlay());
    listen("step", "click", () => this.halted(() => this.stage.step(byId("sample").checked)));
    listen("restart", "click", () => this.halted(() => this.stage.restart()));
    listen("speed", "input", () => this.timer && this.run());
    listen("seen", "change", () => this.show());
    listen("undo", "click", () => this.setGoals(this.stage.waypoints.slice(0, -1)));
    listen("clear", "click", () => this.setGoals([]));
    listen("task", "change", () => byId("task").value && this.newTask(this.stage.data.tasks[Number(byId("task").value)].task));
    listen("fresh", "click", () => {
      byId("task").value = "";
      this.newTask(this.stage.world.sampleTask(this.facts, Math.random));
    });
    listen("find", "click", () => this.find());
    listen("stop", "click", () => (this.searching = false));
    listen("stage", "pointerdown", (event) => this.point(event, true));
    listen("stage", "pointermove", (event) => this.painted !== null && this.point(event, false));
    for (const type of ["pointerup", "pointercancel", "pointerleave"]) listen("stage", type, () => (this.painted = null));
    listen("stage", "keydown", (event) => this.key(event));
    listen("stage", "focus", () => this.focus(byId("stage").matches(":focus-visible")));
    listen("stage", "blur", () => this.focus(false));
    window.addEventListener("resize", () => this.show());
    onScheme(() => this.show());
  }

  /** @param {boolean} has */
  focus(has) {
    this.hasFocus = has;
    this.show();
  }

  /** @param {number} world */
  async choose(world) {
    this.halt();
    const stage = this.stages.get(world) ?? (await this.stageOf(world));
    this.stages.set(world, stage);
    this.stage = stage;
    document.title = `Playground: ${stage.data.name}`;
    byId("worlds").querySelectorAll("button").forEach((/** @type {Element} */ button) =>
      button.setAttribute("aria-pressed", String(button.getAttribute("data-world") === stage.data.name)));
    fill(byId("task"), element("option", { value: "" }, "-"),
      ...stage.data.tasks.map(({ text }, i) => element("option", { value: i }, text ? `${i}: ${text}` : String(i))));
    byId("task").value = "0";
    fill(byId("legend"), ...legendOf(stage.world.legend));
    const names = ["Set goals", ...stage.world.edits.map(({ name }) => name)];
    fill(byId("modes"), ...names.map((name, i) => element("button", { "data-mode": i - 1, onclick: () => this.setMode(i - 1) }, name)));
    byId("modes").hidden = names.length === 1;
    byId("made").textContent = `${stage.data.name}: ${stage.data.summary}. Weights ${stage.data.sha256.slice(0, 12)} in half precision. ` +
      "Everything runs in this page: no server, no network.";
    byId("seen").parentElement.hidden = !stage.world.hidesUnseen;
    const [rows, columns] = stage.world.spots(this.facts);
    stage.cursor = { row: rows >> 1, column: columns >> 1 };
    this.clearFound();
    this.setMode(-1);
  }

  clearFound() {
    byId("found").textContent = "";
    byId("progress").hidden = true;
    fill(byId("found-curve"));
  }

  /** @param {number} mode */
  setMode(mode) {
    this.mode = mode;
    byId("modes").querySelectorAll("button").forEach((/** @type {Element} */ button) =>
      button.setAttribute("aria-pressed", String(Number(button.getAttribute("data-mode")) === mode)));
    byId("stage").classList.toggle("painting", Boolean(this.stage.world.edits[mode]?.paints));
    this.show();
  }

  /** @param {Goal[]} goals */
  setGoals(goals) {
    this.halted(() => {
      this.stage.waypoints = goals;
      this.stage.restart();
    });
  }

  /** @param {any} task */
  newTask(task) {
    this.stage.waypoints = [];
    this.clearFound();
    this.halted(() => this.stage.take(task));
  }

  /** @param {PointerEvent} event @param {boolean} isFirst */
  point(event, isFirst) {
    const spot = spotAt(byId("stage"), this.stage.world, this.facts, event);
    if (spot) this.act(spot, isFirst);
  }

  /** What a click or the Enter key does. @param {Spot} spot @param {boolean} isFirst */
  act(spot, isFirst) {
    if (this.searching) return;
    const { stage, facts } = this, edit = stage.world.edits[this.mode];
    if (edit) {
      if (isFirst) this.painted = edit.paints && edit.paint ? edit.paint(facts, stage.task, spot) : null;
      const task = edit.change(facts, stage.task, spot, this.painted ?? true);
      if (!task) return;
      byId("task").value = "";
      this.clearFound();
      return this.halted(() => stage.take(task));
    }
    const goal = isFirst ? stage.world.goalAt(facts, stage.task, spot) : null;
    if (!goal) return;
    if (!stage.hasRoom) return void (byId("verdict").textContent = `A prompt has at most ${stage.data.network.max_prompt_length} goals.`);
    this.setGoals([...stage.waypoints, goal]);
  }

  /** @param {KeyboardEvent} event */
  key(event) {
    const { stage } = this, [rows, columns] = stage.world.spots(this.facts);
    const move = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
    if (move) {
      const row = (stage.cursor.row + move[0] + rows) % rows, column = (stage.cursor.column + move[1] + columns) % columns;
      stage.cursor = { row, column };
      this.hasFocus = true;
      this.show();
      byId("prompt-text").textContent = `Prompt (at row ${row}, column ${column})`;
    } else if (event.key === "Enter" || event.key === " ") {
      this.act(stage.cursor, true);
      this.painted = null;
    } else if (event.key === "Backspace") this.setGoals(stage.waypoints.slice(0, -1));
    else return;
    event.preventDefault();
  }

  togglePlay() {
    if (this.timer) return this.halted(() => {});
    if (this.stage.play.done) this.stage.restart();
    this.run();
  }

  run() {
    clearInterval(this.timer);
    byId("play").textContent = "Pause";
    this.timer = window.setInterval(() => {
      this.stage.step(byId("sample").checked);
      if (this.stage.play.done) this.halt();
      this.show();
    }, PAUSES[Number(byId("speed").value) - 1]);
  }

  halt() {
    clearInterval(this.timer);
    this.timer = 0;
    this.searching = false;
    byId("play").textContent = "Play";
  }

  /** @param {() => void} act */
  halted(act) {
    this.halt();
    act();
    this.show();
  }

  /** UCB on the present task. */
  async find() {
    this.halted(() => {});
    this.searching = true;
    const { stage } = this, { data, world, task, policy } = stage;
    const space = {
      numSlots: data.network.max_prompt_length, numEpisodes: NUM_EPISODES, returnSpan: data.returnSpan,
      deterministic: data.deterministic, keepRewarded: data.keepRewarded,
    };
    const search = new Search(space, world.taskGoal(data.facts, task), CHANCE);
    /** @type {{ x: number, y: number }[]} */
    const points = [];
    for (const id of ["find", "play", "step", "restart"]) byId(id).disabled = true;
    byId("stop").disabled = false;
    byId("progress").hidden = false;
    let last = performance.now();
    while (this.searching && points.length < NUM_EPISODES) {
      const { goals, isGreedy } = search.ask();
      const episode = runEpisode(policy, world.play(data.facts, task), goals, isGreedy, CHANCE);
      search.tell(goals, episode);
      const best = search.best();
      points.push({ x: points.length + 1, y: data.deterministic ? best.entry : best.mean });
      if (performance.now() - last < 60 && points.length < NUM_EPISODES) continue;
      byId("progress").value = points.length;
      byId("found").textContent = `Episode ${points.length} of ${NUM_EPISODES}: best return ${points[points.length - 1].y.toFixed(2)}`;
      if (this.stage === stage) this.showOther(goals, episode.moments);
      await breathe();
      last = performance.now();
    }
    this.searching = false;
    for (const id of ["find", "play", "step", "restart"]) byId(id).disabled = false;
    byId("stop").disabled = true;
    if (this.stage !== stage || stage.task !== task || !search.arms.length) return;
    const optimum = world.optimum(data.facts, task);
    const known = Number.isFinite(optimum) ? `, the optimum is ${optimum.toFixed(2)}` : "";
    byId("found").textContent = `After ${points.length} episodes: return ${points[points.length - 1].y.toFixed(2)}${known}. Play shows the prompt.`;
    if (points.length > 1) fill(byId("found-curve"), curves({
      series: [{ label: "best prompt", color: "var(--accent)", points }], title: "Return of the best prompt so far", xLabel: "episode",
      lines: Number.isFinite(optimum) ? [{ label: "optimum", y: optimum }] : [],
    }));
    this.setGoals(search.best().prompt.slice(0, -1));
  }

  /** Draw an episode of the search. @param {Goal[]} goals @param {any[]} moments */
  showOther(goals, moments) {
    drawScene(byId("stage"), this.stage.world, this.facts, { task: this.stage.task, goals, moments });
  }

  show() {
    const { stage } = this, { world, data, play } = stage, goals = stage.goals;
    drawScene(byId("stage"), world, data.facts, {
      task: stage.task, goals, moments: stage.moments, onlySeen: byId("seen").checked, cursor: this.hasFocus ? stage.cursor : null,
    });
    const far = goals.map(stage.isFar);
    showPrompt(byId("chips"), goals.map((goal) => world.goalName(data.facts, goal)), far);
    byId("far").hidden = !far.includes(true);
    byId("prompt-text").textContent = `Prompt: up to ${data.network.max_prompt_length - 1} goals of yours, then the task goal`;
    byId("undo").disabled = byId("clear").disabled = !stage.waypoints.length;
    const share = softmax(stage.logits), likeliest = argmax(share);
    fill(byId("bars"), ...world.actions.flatMap((name, i) => [
      element("span", {}, i === likeliest ? element("strong", {}, name) : name),
      element("progress", { max: 1, value: share[i], "aria-label": name }),
      element("output", {}, `${Math.round(100 * share[i])} %`),
    ]));
    byId("verdict").textContent = this.verdict(play);
  }

  /** @param {Play} play */
  verdict(play) {
    const { world, data, task } = this.stage, optimum = world.optimum(data.facts, task);
    const best = Number.isFinite(optimum) ? ` (optimum ${optimum.toFixed(2)})` : "";
    const steps = `${play.numSteps} ${play.numSteps === 1 ? "step" : "steps"}`;
    if (!play.done) return play.numSteps ? `${steps}, return ${play.return_.toFixed(2)}` : `Ready${best}`;
    return `Ended after ${steps}: return ${play.return_.toFixed(2)}${best}`;
  }
}

/** @param {WorldPage[]} worlds @param {{ worlds: WorldData[] }} data */
export async function main(worlds, data) {
  const stageOf = async (/** @type {number} */ i) => {
    const of = data.worlds[i];
    return new Stage(worlds[i], of, new Policy(of.network, await unpack(of.weights)), await farFrom(of.seen));
  };
  await new Playground(data.worlds.map(({ name }) => name), stageOf).begin();
  document.body.dataset.ready = "yes";
}
