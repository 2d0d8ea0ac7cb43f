// The goals that an episode reached, as marks in rows over its steps.

import { range } from "./arrays.js";
import { chartWidth, scale, ticks } from "./chart.js";
import { svg } from "./dom.js";

/** @typedef {{ step: number, goal: Goal }} Reached */

const MOST_ROWS = 40;
const OTHERS = "other goals"; // the last row, if there are more kinds of goals than rows
const ROW = 34, LONGEST = 22; // height of a row, and characters of its name

/**
 * The name of the row of a goal. A goal of named parts is named by these alone, so that goals that also say where
 * something was have the same row wherever it was.
 * @type {(goal: Goal, parts: string[], goalName: (goal: Goal) => string) => string}
 */
function rowName(goal, parts, goalName) {
  const named = parts.filter((_, i) => goal[i] > 0.5);
  if (!named.length) return goalName(goal);
  return named.length === parts.length && named.length > 1 ? "all" : named.join(" + ");
}

/**
 * The rows of a timeline: one for each part and each other kind of goal, and the row of each reached goal.
 * @param {string[]} parts @param {Reached[]} reached @param {(goal: Goal) => string} goalName
 * @returns {{ names: string[], rows: number[] }}
 */
export function timelineRows(parts, reached, goalName) {
  const own = reached.map(({ goal }) => rowName(goal, parts, goalName));
  const all = [...new Set([...parts, ...own])];
  const names = all.length > MOST_ROWS ? [...all.slice(0, MOST_ROWS - 1), OTHERS] : all;
  return { names, rows: own.map((name) => Math.min(all.indexOf(name), names.length - 1)) };
}

/**
 * The goals that an episode reached, in the order of their steps.
 * @param {import("./log.js").Log} log @param {{ seed: number, task: number, episode: number }} place
 * @param {string[]} parts @param {(goal: Goal) => string} goalName
 */
export function timeline(log, { seed, task, episode }, parts, goalName) {
  const reached = log.reached(seed, task, episode), { names, rows } = timelineRows(parts, reached, goalName);
  const last = range(log.numEpisodes).reduce((most, e) => log.reached(seed, task, e).reduce((m, { step }) => Math.max(m, step), most), 1);
  const width = chartWidth(640), longest = Math.max(0, ...names.map((name) => Math.min(name.length, LONGEST)));
  const left = Math.max(60, 20 + 7.6 * longest), x = scale(0, last, left, width - 24), height = ROW * names.length + 34;
  const middle = (/** @type {number} */ row) => ROW * (row + 0.5);
  const text = reached.map(({ step, goal }) => `${goalName(goal)} in step ${step}`).join(", ") || "no goal was reached";
  return svg("svg", { viewBox: `0 0 ${width} ${height}`, class: "chart timeline", role: "img", "aria-label": `Goals reached: ${text}` },
    ...names.flatMap((name, row) => [
      svg("line", { x1: left, x2: width - 12, y1: middle(row), y2: middle(row), class: "grid" }),
      svg("text", { x: left - 10, y: middle(row) + 4, "text-anchor": "end" }, name.slice(0, LONGEST)),
    ]),
    ...ticks(0, last, 5).map((step) => svg("text", { x: x(step), y: height - 8, "text-anchor": "middle" }, String(step))),
    svg("text", { x: 8, y: height - 8 }, "step"),
    ...reached.flatMap(({ step, goal }, i) => {
      const number = svg("text", { x: x(step), y: middle(rows[i]) + 4.5, "text-anchor": "middle", class: "on" }, String(i + 1));
      number.style.fill = log.ink;
      return [svg("circle", { cx: x(step), cy: middle(rows[i]), r: 11, fill: log.color }), number];
    }));
}
