// The report: what was run, curves, all tasks, and a viewer that steps through every episode.

import { addressOf, placeOf, writeAddress } from "./address.js";
import { mean, range } from "./arrays.js";
import { chartWidth, curves, scale, ticks } from "./chart.js";
import { byId, drawScene, element, fill, isDark, legendOf, onScheme, sayReady, showPrompt, svg } from "./dom.js";
import { hasKnown, knownTitle, showKnown } from "./known.js";
import { Log } from "./log.js";
import { announcer, settled } from "./pace.js";
import { timeline } from "./timeline.js";

/**
 * @typedef {{ name: string, summary: string, facts: any, parts: string[] }} WorldData
 * @typedef {{ world: WorldData, tasks: { task: any, text: string }[], optimum: number[] | null, withEpisodes: boolean, notes: string[],
 *   pictures?: { name: string, source: string }[], runs: import("./log.js").RunData[] }} ReportData
 * @typedef {import("./address.js").Place} Place
 * @typedef {{ name: string, shown: string, by: (task: number) => number, value: (task: number) => number }} Order
 *   shown: what the value of a task is, in words; tasks with the lowest ``by`` come first
 */

const SOLVED = 1e-4; // a smaller regret counts as an optimal solution
const PLAY_MS = 450;
const ADDRESS_MS = 350; // the address follows once no other episode was chosen for so long

/** Names for goals: the world's, those of its parts, or its numbers. @type {(world: WorldDrawing | null, data: WorldData) => (goal: Goal) => string} */
function goalNamer(world, { facts, parts }) {
  if (world) return (goal) => world.goalName(facts, goal);
  if (parts.length)
    return (goal) => Array.from(goal).flatMap((value, i) => (value > 0.5 ? [parts[i] ?? String(i)] : [])).join(" + ") || "none";
  return (goal) => `(${Array.from(goal, (value) => Number(value.toFixed(2))).join(", ")})`;
}

/** A table of facts, one column for each run. @param {Log[]} logs */
function factsTable(logs) {
  const names = logs[0].data.facts.map(([name]) => name);
  const rows = names.map((name, i) => ({ name, values: logs.map((log) => log.data.facts[i][1]) }));
  const head = logs.map(({ data, color }) => {
    const swatch = element("span", { class: "swatch" });
    swatch.style.background = color;
    return element("th", { scope: "col" }, swatch, data.label);
  });
  return element("table", { class: "facts" },
    element("thead", {}, element("tr", {}, element("td", {}), ...head)),
    element("tbody", {}, ...rows.filter(({ values }) => values.some(Boolean)).map(({ name, values }) =>
      element("tr", {}, element("th", { scope: "row" }, name), ...values.map((value) => element("td", {}, value || "-"))))));
}

/** Mean over tasks and seeds of the judged returns, with the spread over seeds. @param {Log} log @param {number} index */
function seriesOf(log, index) {
  const points = range(log.numJudged).map((c) => {
    const ofSeeds = range(log.numSeeds).map((seed) => mean(range(log.numTasks).map((task) => log.judged(seed, task, c))));
    const y = mean(ofSeeds), std = Math.sqrt(mean(ofSeeds.map((value) => (value - y) ** 2)));
    const x = log.arrays.evalEpisodes.data[c];
    return log.numSeeds > 1 ? { x, y, low: y - std, high: y + std } : { x, y };
  });
  return { label: log.data.label, color: log.color, dash: ["", "7 4", "2 3"][index % 3] || undefined, points };
}

class Report {
  /** @param {WorldDrawing | null} world @param {ReportData} data @param {Log[]} logs */
  constructor(world, data, logs) {
    this.world = world;
    this.data = data;
    this.logs = logs;
    this.goalName = goalNamer(world, data.world);
    /** @type {Place} */
    this.place = { run: 0, task: 0, seed: 0, episode: logs[0].numEpisodes - 1 };
    this.timer = 0;
    this.announce = announcer(byId("said"));
    this.writeAddress = settled(writeAddress, ADDRESS_MS);
    /** @type {Map<number, any[]>} */
    this.walks = new Map();
  }

  get log() {
    return this.logs[this.place.run];
  }

  /** Whether episodes of the run can be drawn. */
  get canDraw() {
    return Boolean(this.world) && (this.log.hasActions || this.log.hasTracks);
  }

  /** Whether the episode that is looked at can be drawn. */
  get isDrawn() {
    const { log, place: { seed, task, episode } } = this;
    return this.canDraw && (log.hasActions || log.isTracked(seed, task, episode));
  }

  begin() {
    const { data, logs } = this;
    this.setColors();
    document.title = `${data.world.name}: ${logs.map((log) => log.data.label).join(", ")}`;
    byId("title").textContent = `Adaptation to ${data.tasks.length} tasks of ${data.world.name}`;
    byId("summary").textContent = data.world.summary;
    fill(byId("notes"), ...data.notes.map((note) => element(note.startsWith("python ") ? "pre" : "p", { class: "quiet" }, note)));
    fill(byId("head"), factsTable(logs));
    fill(byId("comparisons"), ...logs.slice(1).map((log) =>
      element("p", {}, `${log.data.label} minus ${logs[0].data.label}, paired by task, with 95 % intervals over seeds: ${log.data.comparison}.`)));
    this.drawCurves();
    this.showPictures();
    this.prepareTasks();
    this.prepareViewer();
    this.go(placeOf(location.hash, this.place));
    window.addEventListener("hashchange", () => this.go(placeOf(location.hash, this.place)));
    window.addEventListener("resize", () => this.draw());
    onScheme(() => this.redraw());
  }

  /** Give the runs their colors in the page's present scheme. */
  setColors() {
    const scheme = isDark() ? "dark" : "light", { style } = document.documentElement;
    this.logs.forEach((log, i) => {
      const [line, ink] = log.data.colors[scheme];
      style.setProperty(`--run-${i}`, line);
      style.setProperty(`--run-${i}-ink`, ink);
    });
  }

  redraw() {
    this.setColors();
    this.drawThumbnails();
    this.draw();
  }

  drawCurves() {
    const { data, logs } = this;
    const lines = data.optimum ? [{ label: "optimum", y: mean(data.optimum) }] : [];
    fill(byId("curves"), curves({
      title: "Mean return over tasks and seeds of the best prompt after each number of episodes",
      xLabel: "episode", series: logs.map(seriesOf), lines,
    }));
    fill(byId("curves-legend"), ...logs.map((log, i) => {
      const line = svg("svg", { width: 34, height: 10, "aria-hidden": "true" },
        svg("line", { x1: 0, x2: 30, y1: 5, y2: 5, stroke: log.color, "stroke-width": 3, "stroke-dasharray": ["", "7 4", "2 3"][i % 3] || null }));
      return element("span", { class: "entry" }, line, log.data.label);
    }), element("span", { class: "entry" }, "bands: standard deviation over seeds"));
  }

  showPictures() {
    const pictures = this.data.pictures ?? [];
    byId("pictures-section").hidden = !pictures.length;
    fill(byId("pictures"), ...pictures.map(({ name, source }) =>
      element("figure", {}, element("img", { src: source, alt: name }), element("figcaption", { class: "quiet" }, name))));
  }

  /** What tasks can be sorted by. @returns {Order[]} */
  orders() {
    const { data: { optimum }, log, logs } = this;
    const final = (/** @type {Log} */ one, /** @type {number} */ task) => one.judgedMean(task, one.numJudged - 1);
    const gain = (/** @type {number} */ task) => final(log, task) - log.judgedMean(task, 0);
    /** @type {Order[]} */
    const orders = [
      { name: "number", shown: "the mean return at the end", by: (task) => task, value: (task) => final(log, task) },
      { name: "gain, largest first", shown: "the gain in mean return", by: (task) => -gain(task), value: gain },
    ];
    /** @type {(name: string, shown: string, lost: (task: number) => number) => void} */
    const addLoss = (name, shown, lost) => orders.push({ name, shown, by: (task) => -lost(task), value: lost });
    if (optimum) addLoss("regret, largest first", "the regret of the mean return at the end", (task) => optimum[task] - final(log, task));
    for (const other of logs.filter((one) => one !== log)) {
      const { label } = other.data;
      addLoss(`loss against ${label}, largest first`, `by how much ${label} ended higher`, (task) => final(other, task) - final(log, task));
    }
    return orders;
  }

  prepareTasks() {
    const names = this.logs.map((log, i) => element("option", { value: i }, log.data.label));
    fill(byId("shown-run"), ...names.map((name) => name.cloneNode(true)));
    fill(byId("run"), ...names);
    for (const id of ["shown-run", "run"]) {
      byId(id).parentElement.hidden = this.logs.length < 2;
      byId(id).addEventListener("change", () => this.go({ ...this.place, run: Number(byId(id).value) }));
    }
    byId("sort").addEventListener("change", () => this.showTasks());
    const buttons = this.data.tasks.map(({ text }, task) => {
      const canvas = this.world ? element("canvas", { "aria-hidden": "true" }) : null;
      return element("button", { "data-task": task, title: text, onclick: () => this.chooseTask(task) }, canvas, element("span", {}));
    });
    fill(byId("tasks"), ...buttons);
    this.buttons = buttons;
  }

  /** @param {number} task */
  chooseTask(task) {
    this.go({ ...this.place, task });
    byId("viewer").scrollIntoView({ behavior: "smooth" });
  }

  showTasks() {
    const { log, data, data: { optimum } } = this, last = log.numJudged - 1, orders = this.orders();
    const chosen = Math.min(Math.max(byId("sort").selectedIndex, 0), orders.length - 1), order = orders[chosen];
    fill(byId("sort"), ...orders.map(({ name }, i) => element("option", { value: i, selected: i === chosen }, name)));
    byId("tasks-note").textContent = `Below each task: its number and ${order.shown}.` +
      (optimum ? " A double frame: optimal with every seed." : "");
    this.buttons?.forEach((button, task) => {
      const value = order.value(task).toFixed(2);
      const solved = Boolean(optimum) && range(log.numSeeds).every((seed) => (optimum?.[task] ?? 0) - log.judged(seed, task, last) < SOLVED);
      button.classList.toggle("solved", solved);
      button.querySelector("span").textContent = `${task}: ${value}`;
      button.setAttribute("aria-label", `task ${task}, ${data.tasks[task].text}, ${order.shown}: ${value}${solved ? ", solved" : ""}`);
    });
    const sorted = range(data.tasks.length).sort((a, b) => order.by(a) - order.by(b) || a - b);
    byId("tasks").append(...sorted.map((task) => this.buttons?.[task]));
    this.drawThumbnails();
  }

  drawThumbnails() {
    const { world } = this;
    if (!world) return;
    this.buttons?.forEach((button, task) => {
      const episode = this.log.numEpisodes - 1;
      const goals = this.log.hasPrompts ? this.log.prompt(this.log.ofRound("best", 0, task, episode)) : [];
      drawScene(button.querySelector("canvas"), world, this.data.world.facts, { task: this.data.tasks[task].task, goals, moments: [] });
    });
  }

  prepareViewer() {
    const step = (/** @type {number} */ by) => this.go({ ...this.place, episode: this.place.episode + by });
    byId("back").addEventListener("click", () => step(-1));
    byId("next").addEventListener("click", () => step(1));
    byId("play").addEventListener("click", () => this.togglePlay());
    byId("episode").addEventListener("input", () => this.go({ ...this.place, episode: Number(byId("episode").value) - 1 }));
    byId("seed").addEventListener("change", () => this.go({ ...this.place, seed: Number(byId("seed").value) }));
    byId("visits").addEventListener("change", () => this.draw());
    document.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      const within = /** @type {Element} */ (event.target).matches?.("input, select, .wide");
      if (by && !within && !event.altKey && !event.ctrlKey && !event.metaKey) step(by);
    });
    if (this.world) fill(byId("legend"), ...legendOf(this.world.legend, this.data.world.facts));
  }

  togglePlay() {
    const stop = () => {
      clearInterval(this.timer);
      this.timer = 0;
      byId("play").textContent = "Play";
    };
    if (this.timer) return stop();
    if (this.place.episode >= this.log.numEpisodes - 1) this.go({ ...this.place, episode: 0 });
    byId("play").textContent = "Pause";
    this.timer = window.setInterval(() => {
      if (this.place.episode >= this.log.numEpisodes - 1) stop();
      else this.go({ ...this.place, episode: this.place.episode + 1 });
    }, PLAY_MS);
  }

  /** Show a place, or the nearest one that there is. @param {Place} wanted */
  go(wanted) {
    const within = (/** @type {number} */ value, /** @type {number} */ num) => Math.min(Math.max(value, 0), num - 1);
    const before = this.place, run = within(wanted.run, this.logs.length), log = this.logs[run];
    this.place = {
      run, task: within(wanted.task, log.numTasks), seed: within(wanted.seed, log.numSeeds), episode: within(wanted.episode, log.numEpisodes),
    };
    if (before.run !== run || !this.shown) this.showRun();
    this.shown = true;
    this.show();
    this.writeAddress(addressOf(this.place));
  }

  showRun() {
    const { log } = this;
    byId("shown-run").value = byId("run").value = String(this.place.run);
    fill(byId("seed"), ...range(log.numSeeds).map((seed) => element("option", { value: seed }, String(seed))));
    byId("episode").max = log.numEpisodes;
    byId("arms-section").hidden = !hasKnown(log) && !log.data.note;
    byId("arms-title").textContent = knownTitle(log);
    byId("visits-label").hidden = !this.canDraw;
    byId("visits-text").textContent = `visits of all ${log.trackStride > 1 ? "drawn " : ""}episodes up to here`;
    fill(byId("stage-place"), this.canDraw ? element("canvas", { class: "stage still", id: "stage", role: "img" }) : null);
    this.walks.clear();
    this.showTasks();
  }

  show() {
    const { log, data, place: { run, task, seed, episode } } = this;
    byId("stage-title").textContent = `Task ${task}, seed ${seed}, episode ${episode + 1}`;
    byId("seed").value = String(seed);
    byId("episode").value = String(episode + 1);
    byId("back").disabled = episode === 0;
    byId("next").disabled = episode === log.numEpisodes - 1;
    this.buttons?.forEach((button, i) => {
      button.setAttribute("aria-pressed", String(i === task));
    });
    const best = Math.max(...range(episode + 1).map((e) => log.return_(seed, task, e)));
    const optimum = data.optimum ? `, optimum ${data.optimum[task].toFixed(2)}` : "";
    byId("verdict").textContent = `Return ${log.return_(seed, task, episode).toFixed(2)} (best so far ${best.toFixed(2)}${optimum})`;
    this.announce(`${byId("stage-title").textContent}. ${byId("verdict").textContent}`);
    const greedy = log.hasPrompts ? (log.ofRound("greedy", seed, task, episode) ? "greedy actions" : "sampled actions") : "";
    byId("kind").textContent = [data.tasks[task].text, greedy, this.logs.length > 1 ? this.logs[run].data.label : ""].filter(Boolean).join("; ");
    for (const [id, which] of /** @type {["chips" | "best", "choice" | "best"][]} */ ([["chips", "choice"], ["best", "best"]])) {
      const prompt = log.hasPrompts ? log.ofRound(which, seed, task, episode) : -1;
      if (prompt < 0) fill(byId(id), element("span", { class: "quiet" }, "none"));
      else showPrompt(byId(id), log.prompt(prompt).map(this.goalName), log.isFar(prompt));
    }
    fill(byId("returns"), this.returnsChart());
    this.draw();
  }

  /** What stands below the picture of the episode. */
  stageNote() {
    const { log } = this;
    if (!this.data.withEpisodes) return "Episode details are left out, because the page would be too large.";
    if (!this.canDraw && !log.hasReached) return "These results do not include the course of their episodes.";
    if (!this.canDraw || this.isDrawn) return "";
    if (this.place.episode % log.trackStride === 0) return "Not drawn on the map: replaying this episode does not reproduce the recorded goals.";
    return `Not drawn on the map, as only the first of every ${log.trackStride} episodes is.`;
  }

  /** The moments of an episode, tracked or played again by the rules. @param {number} episode */
  walk(episode) {
    const { world, log, place: { task, seed } } = this, at = log.at(seed, task, episode);
    if (log.hasTracks) {
      if (!this.walks.has(at)) this.walks.set(at, world?.moments?.(log.track(seed, task, episode)) ?? []);
    } else if (!this.walks.has(at) && world?.play) {
      const play = world.play(this.data.world.facts, this.data.tasks[task].task);
      play.reset(log.start(seed, task, episode));
      const moments = [play.moment()];
      for (const action of Array.from(log.actions(seed, task, episode))) {
        play.step(action);
        moments.push(play.moment());
      }
      this.walks.set(at, moments);
    }
    return this.walks.get(at) ?? [];
  }

  draw() {
    const { world, log, data, isDrawn, place: { task, seed, episode } } = this;
    byId("stage-note").textContent = this.stageNote();
    byId("legend").hidden = !isDrawn;
    if (this.canDraw) byId("stage").hidden = !isDrawn;
    if (world && isDrawn) {
      const goals = log.hasPrompts ? log.prompt(log.ofRound("choice", seed, task, episode)) : [];
      const earlier = byId("visits").checked ? range(episode + 1).map((e) => this.walk(e)) : undefined;
      drawScene(byId("stage"), world, data.world.facts, { task: data.tasks[task].task, goals, moments: this.walk(episode), earlier });
    }
    fill(byId("timeline-place"), log.hasReached ? timeline(log, this.place, data.world.parts, this.goalName) : null);
    this.showKnown();
  }

  returnsChart() {
    const { log, place: { task, seed, episode } } = this, width = chartWidth(480), height = 190, left = 44;
    const values = range(log.numEpisodes).map((e) => log.return_(seed, task, e));
    const optimum = this.data.optimum?.[task];
    const all = optimum === undefined ? values : [...values, optimum];
    const low = Math.min(...all), high = Math.max(...all);
    const x = scale(0, Math.max(1, log.numEpisodes - 1), left + 6, width - 18), y = scale(low, low === high ? low + 1 : high, height - 34, 12);
    const isGreedy = (/** @type {number} */ e) => log.hasPrompts && Boolean(log.ofRound("greedy", seed, task, e));
    const drawing = svg("svg", {
      viewBox: `0 0 ${width} ${height}`, class: "chart", role: "img", "aria-label": `Returns of ${log.numEpisodes} episodes, from ${low.toFixed(2)} to ${high.toFixed(2)}`,
      onclick: (/** @type {MouseEvent} */ event) => {
        const box = drawing.getBoundingClientRect(), at = ((event.clientX - box.left) / box.width) * width;
        const wanted = Math.round(((at - left - 6) / (width - 24 - left)) * (log.numEpisodes - 1));
        this.go({ ...this.place, episode: wanted });
      },
    },
    ...(low === high ? [low] : ticks(low, high, 4)).flatMap((value) => [
      svg("line", { x1: left, x2: width, y1: y(value), y2: y(value), class: "grid" }),
      svg("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, String(Number(value.toFixed(3)))),
    ]),
    optimum === undefined ? null : svg("line", { x1: left, x2: width, y1: y(optimum), y2: y(optimum), class: "optimum" }),
    ...ticks(1, Math.max(2, log.numEpisodes), 5).map((e) => svg("text", { x: x(e - 1), y: height - 16, "text-anchor": "middle" }, String(e))),
    svg("text", { x: (left + width) / 2, y: height - 2, "text-anchor": "middle" }, "episode"),
    ...values.map((value, e) => svg("circle", {
      cx: x(e), cy: y(value), r: e === episode ? 7 : 3.4, fill: isGreedy(e) || e === episode ? log.color : "none", stroke: log.color, "stroke-width": 1.3,
    })));
    return element("div", {}, drawing, element("p", { class: "quiet" }, `Filled: greedy actions. Open: sampled actions. Large: this episode. ${optimum === undefined ? "" : "Dashed line: optimum. "}Click to choose an episode.`));
  }

  showKnown() {
    const { log, world, data, goalName, place: { task, seed, episode } } = this;
    showKnown(byId("arms"), { log, world, facts: data.world.facts, task: data.tasks[task].task, seed, number: task, episode, goalName });
  }
}

/** @param {(WorldDrawing | null)[]} worlds @param {ReportData} data */
export async function main(worlds, data) {
  const logs = await Promise.all(data.runs.map((run, i) => Log.of(run, i)));
  new Report(worlds[0], data, logs).begin();
  sayReady();
}
