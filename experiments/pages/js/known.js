// What an optimizer knew after an episode: its arms, its map, the order that it found, or what prompts are worth.

import { drawScene, element, fill, legendOf } from "./dom.js";

/**
 * @typedef {import("./log.js").Log} Log
 * @typedef {{ log: Log, world: WorldDrawing | null, facts: any, task: any, seed: number, number: number, episode: number,
 *   goalName: (goal: Goal) => string }} View the episode that is looked at; number is that of the task
 */

/** Whether there is anything to show. @type {(log: Log) => boolean} */
export const hasKnown = (log) => log.hasArms || log.hasMap || log.hasOrder || log.hasWorths;

/** What stands above it. @type {(log: Log) => string} */
export function knownTitle(log) {
  if (!hasKnown(log)) return "What the optimizer knew";
  const what = log.hasMap ? "its map" : log.hasOrder ? "the order" : log.hasWorths ? "the estimated returns of prompts" : "its arms";
  return `What the optimizer knew: ${what} after this episode`;
}

/** @param {HTMLElement} parent @param {View} view */
export function showKnown(parent, view) {
  const { log } = view;
  parent.classList.toggle("scrolls", !log.hasMap);
  if (log.hasMap) showMap(parent, view);
  else if (log.hasOrder) showOrder(parent, view);
  else if (log.hasWorths) showWorths(parent, view);
  else if (log.hasArms) showArms(parent, view);
  else parent.textContent = log.data.note;
}

/** A row of a table that is marked if it is of this episode. @param {boolean} isNow @param {string[]} cells */
const row = (isNow, cells) => element("tr", { class: isNow ? "now" : null }, ...cells.map((text) => element("td", {}, text)));

/** @param {string[]} names @param {HTMLElement[]} rows */
function table(names, rows) {
  const head = names.map((name) => element("th", { scope: "col" }, name));
  return element("table", {}, element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...rows));
}

/** Goals one after another. @param {Goal[]} goals @param {(goal: Goal) => string} name */
const sequence = (goals, name) => goals.map(name).join(" → ");

/** @param {HTMLElement} parent @param {View} view */
function showArms(parent, { log, seed, number, episode, goalName }) {
  const rows = log.arms(seed, number, episode).map(({ goals, pulls, mean, isNew, isChanged }, i) =>
    row(isChanged, [`${i + 1}${isNew ? " new" : isChanged ? " acted" : ""}`, sequence(goals, goalName), String(pulls), mean.toFixed(2)]));
  fill(parent, table(["arm", "prompt", "episodes", "mean return"], rows));
}

/** The map with the best prompt so far; in words alone where the world does not draw it. @param {HTMLElement} parent @param {View} view */
function showMap(parent, { log, world, facts, task, seed, number, episode, goalName }) {
  const { goals, visits, way, verified } = log.map(seed, number, episode);
  const total = visits.reduce((sum, count) => sum + count, 0);
  const steps = way.length === 1 ? "1 step" : `${way.length} steps`;
  const text = `${goals.length} states, visited ${total} times. ` +
    (way.length ? `The shortest known way takes ${steps}` : "No way to the task goal is known yet") +
    (verified ? `; the shortest greedy episode that arrived took ${verified}.` : "; no greedy episode has arrived yet.");
  if (!world?.legendOfKnown)
    return fill(parent, element("p", {}, text), way.length ? element("p", { class: "quiet" }, sequence(way, goalName)) : null);
  const canvas = element("canvas", { class: "stage still", role: "img" });
  fill(parent, canvas, element("div", { class: "legend" }, ...legendOf(world.legendOfKnown, facts)), element("p", { class: "quiet" }, text));
  const best = log.prompt(log.ofRound("best", seed, number, episode));
  drawScene(canvas, world, facts, { task, goals: best, moments: [], known: { goals, visits, way } });
  canvas.setAttribute("aria-label", `Map of what was seen, with the best prompt so far. ${text}`);
}

/** @param {HTMLElement} parent @param {View} view */
function showOrder(parent, { log, seed, number, episode, goalName }) {
  const { confirmed, excluded, isComplete } = log.order(seed, number, episode);
  const chips = confirmed.map((goal, i) => element("span", { class: "chip" }, element("b", {}, String(i + 1)), goalName(goal)));
  const after = confirmed.length ? "after it" : "at first";
  fill(parent,
    element("p", {}, isComplete ? "The order is known:" : "Confirmed so far:"),
    element("div", { class: "chips" }, ...(chips.length ? chips : [element("span", { class: "quiet" }, "nothing")])),
    isComplete ? null : element("p", {}, `Ruled out ${after}: ${excluded.map(goalName).join(", ") || "nothing"}.`));
}

/** @param {HTMLElement} parent @param {View} view */
function showWorths(parent, { log, seed, number, episode, goalName }) {
  const rows = log.worths(seed, number, episode).map(({ goals, first, tries, mean, std }, i) =>
    row(first === episode, [String(i + 1), sequence(goals, goalName), String(tries), `${mean.toFixed(2)} ± ${std.toFixed(2)}`]));
  fill(parent, table(["rank", "prompt", "episodes", "return (posterior mean ± standard deviation)"], rows));
}
