// The playground: anyone guides a frozen policy by clicking goals, and UCB finds prompts in the page.

import { unpack } from "./arrays.js";
import { curves } from "./chart.js";
import { Policy, argmax, softmax } from "./decoder.js";
import { byId, drawScene, element, fill, legendOf, onScheme, sayReady, showPrompt, spotAt } from "./dom.js";
import { announcer } from "./pace.js";
import { farFrom } from "./seen.js";
import { spotsBetween } from "./spots.js";
import { Stage } from "./stage.js";

/** @typedef {import("./stage.js").WorldData} WorldData */

const NUM_EPISODES = 100;
const PAUSES = [900, 450, 220, 100, 40, 0]; // milliseconds between steps, by speed
const DRAW_MS = 60; // a search draws its last episode this often
const ACTING = ["find", "play", "step", "restart"]; // buttons that are off during a search

/** Lets the page answer before a long computation goes on. */
const breathe = () => new Promise((resolve) => setTimeout(resolve));

export class Playground {
  /** @param {string[]} names @param {(world: number) => Promise<Stage>} stageOf builds a stage, which takes a moment */
  constructor(names, stageOf) {
    this.names = names;
    this.stageOf = stageOf;
    /** @type {Map<number, Promise<Stage>>} */
    this.stages = new Map();
    this.stage = /** @type {Stage} */ (/** @type {unknown} */ (null)); // set by ``choose``
    this.numChosen = 0; // how often a world was chosen; the last choice counts
    this.mode = -1; // sets goals; else the number of an edit of the world
    this.timer = 0;
    this.searching = false;
    /** @type {boolean | null} what painting sets; null while nothing is painted */
    this.painted = null;
    /** @type {Spot | null} where painting was last */
    this.lastPainted = null;
    this.hasFocus = false;
    this.announce = announcer(byId("said"));
  }

  get facts() {
    return this.stage.data.facts;
  }

  async begin() {
    await this.choose(0);
    fill(byId("worlds"), ...(this.names.length > 1 ? this.names : []).map((name, i) =>
      element("button", { "data-world": name, onclick: () => this.choose(i) }, name)));
    this.pressWorld();
    const listen = (/** @type {string} */ id, /** @type {string} */ type, /** @type {(event: any) => void} */ act) =>
      byId(id).addEventListener(type, act);
    listen("play", "click", () => this.togglePlay());
    listen("step", "click", () => {
      this.halted(() => this.stage.step(byId("sample").checked));
      this.announce(byId("verdict").textContent);
    });
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
    listen("stage", "click", (event) => this.click(event));
    listen("stage", "pointerdown", (event) => this.beginPainting(event));
    listen("stage", "pointermove", (event) => this.goOnPainting(event));
    for (const type of ["pointerup", "pointercancel", "pointerleave"]) listen("stage", type, () => this.endPainting());
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

  /** Show a world. It may have to load; the world that was chosen last is shown. @param {number} world */
  async choose(world) {
    this.halt();
    const number = ++this.numChosen;
    const loading = this.stages.get(world) ?? this.stageOf(world);
    this.stages.set(world, loading);
    const stage = await loading;
    if (number !== this.numChosen) return;
    this.halt(); // playing or a search that began while the world was loading
    this.stage = stage;
    document.title = `Playground: ${stage.data.name}`;
    this.pressWorld();
    fill(byId("task"), element("option", { value: "" }, "-"),
      ...stage.data.tasks.map(({ text }, i) => element("option", { value: i }, text ? `${i}: ${text}` : String(i))));
    byId("task").value = "0";
    fill(byId("legend"), ...legendOf(stage.world.legend, stage.data.facts));
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

  /** Mark the button of the world that is shown. */
  pressWorld() {
    byId("worlds").querySelectorAll("button").forEach((/** @type {Element} */ button) =>
      button.setAttribute("aria-pressed", String(button.getAttribute("data-world") === this.stage.data.name)));
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

  /** The edit of the world that clicks make; undefined where they set goals. */
  get edit() {
    return this.stage.world.edits[this.mode];
  }

  /** @param {PointerEvent} event */
  spotOf(event) {
    return spotAt(byId("stage"), this.stage.world, this.facts, event);
  }

  /**
   * A click, and not the press of a pointer, sets a goal: a finger that scrolls or pinches makes no click.
   * @param {PointerEvent} event
   */
  click(event) {
    const spot = event.button === 0 && !this.edit?.paints ? this.spotOf(event) : null;
    if (spot) this.act(spot);
  }

  /** @param {PointerEvent} event */
  beginPainting(event) {
    if (!this.edit?.paints || event.button !== 0 || !event.isPrimary || this.searching) return;
    const spot = this.spotOf(event);
    if (spot) this.paint(spot);
  }

  /** @param {PointerEvent} event */
  goOnPainting(event) {
    const spot = this.painted !== null && event.isPrimary ? this.spotOf(event) : null;
    if (spot) this.paint(spot);
  }

  endPainting() {
    this.painted = this.lastPainted = null;
  }

  /** Paint all spots from the last one to this one, since a fast pointer skips some. @param {Spot} spot */
  paint(spot) {
    const { edit, facts, stage: { task } } = this;
    this.painted ??= edit.paint ? edit.paint(facts, task, spot) : true;
    const spots = spotsBetween(this.lastPainted ?? spot, spot);
    this.lastPainted = spot;
    this.changeTask(spots.reduce((changed, one) => edit.change(facts, changed, one, this.painted ?? true) ?? changed, task));
  }

  /** What a click or the Enter key does. @param {Spot} spot */
  act(spot) {
    if (this.searching) return;
    if (this.edit) {
      this.paint(spot);
      return this.endPainting();
    }
    const { stage } = this, goal = stage.world.goalAt(this.facts, stage.task, spot);
    if (!goal) return this.announce(stage.tellSpot(spot));
    if (!stage.hasRoom) {
      const text = `A prompt has at most ${stage.data.network.max_prompt_length} goals.`;
      byId("verdict").textContent = text;
      return this.announce(text);
    }
    this.setGoals([...stage.waypoints, goal]);
    this.announce(stage.tellSpot(spot));
  }

  /** @param {any} task */
  changeTask(task) {
    if (task === this.stage.task) return;
    byId("task").value = "";
    this.clearFound();
    this.halted(() => this.stage.take(task));
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
      this.announce(stage.tellSpot(stage.cursor));
    } else if (event.key === "Enter" || event.key === " ") this.act(stage.cursor);
    else if (event.key === "Backspace") this.setGoals(stage.waypoints.slice(0, -1));
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
      this.announce(byId("verdict").textContent);
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
    const { stage } = this, { task, waypoints } = stage;
    this.setActing(false);
    byId("progress").hidden = false;
    let last = performance.now();
    const { returns, prompt } = await stage.search(NUM_EPISODES, async (progress) => {
      if (performance.now() - last >= DRAW_MS || progress.returns.length === NUM_EPISODES) {
        if (this.stage === stage) this.showProgress(progress);
        await breathe();
        last = performance.now();
      }
      return this.searching;
    });
    this.searching = false;
    this.setActing(true);
    if (this.stage !== stage) return;
    if (stage.task !== task || stage.waypoints !== waypoints) { // the user has changed them meanwhile
      this.clearFound();
      return this.show();
    }
    this.setGoals(prompt.slice(0, -1));
    this.showFound(returns);
  }

  /** Turn the buttons on that act, and off that stops a search, or the other way round. @param {boolean} acts */
  setActing(acts) {
    for (const id of ACTING) byId(id).disabled = !acts;
    byId("stop").disabled = acts;
  }

  /** @param {import("./stage.js").Progress} progress */
  showProgress({ returns, goals, moments }) {
    byId("progress").value = returns.length;
    byId("found").textContent = `Episode ${returns.length} of ${NUM_EPISODES}: best return ${returns[returns.length - 1].toFixed(2)}`;
    this.announce(byId("found").textContent);
    this.showOther(goals, moments);
  }

  /** What a search found. @param {number[]} returns of the best prompt after each episode */
  showFound(returns) {
    const { optimum } = this.stage;
    const known = Number.isFinite(optimum) ? `, the optimum is ${optimum.toFixed(2)}` : "";
    byId("found").textContent = `After ${returns.length} episodes: return ${returns[returns.length - 1].toFixed(2)}${known}. Play shows the prompt.`;
    this.announce(byId("found").textContent);
    if (returns.length < 2) return;
    const points = returns.map((y, i) => ({ x: i + 1, y }));
    fill(byId("found-curve"), curves({
      series: [{ label: "best prompt", color: "var(--accent)", points }], title: "Return of the best prompt so far", xLabel: "episode",
      lines: Number.isFinite(optimum) ? [{ label: "optimum", y: optimum }] : [],
    }));
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
    const { optimum } = this.stage;
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
  sayReady();
}
