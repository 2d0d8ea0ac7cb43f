// Crafter for HTML pages: the map of a world at its start, with the way of an agent and what it unlocked.

/**
 * @typedef {{ side: number, unit: number, places: boolean, achievements: string[], achievementColors: string[],
 *   kinds: [string, string][], promptColor: string, blocks: string[], blockColors: string[] }} Facts
 * @typedef {string[]} Task rows of letters, one for each block; a is the first kind
 * @typedef {{ row: number, column: number, unlocked: number }} Moment unlocked: the achievement of this moment, or -1
 * @typedef {{ step: number, goal: number, home: [number, number] }} Unlock places as (row, column)
 * @typedef {{ home: [number, number], center: [number, number], label: string, color: string, half: number, isBox: boolean }} Mark
 */

const MARK = 1.25; // radius of a mark in cells
const INK = "#1f292e", PAPER = "#ffffff"; // on a map, whose colors are those of the game in a dark page, too

/** The achievements that a goal names. @type {(facts: Facts, goal: Goal) => number[]} */
const named = (facts, goal) => [...facts.achievements.keys()].filter((achievement) => goal[achievement] > 0.5);

/** The cell that a goal names, where goals have places and this one is known. @type {(facts: Facts, goal: Goal) => [number, number] | null} */
function placeOf(facts, goal) {
  const [isKnown, down, right] = Array.from(goal).slice(facts.achievements.length);
  return isKnown > 0.5 ? [Math.round(facts.side / 2 + down * facts.unit), Math.round(facts.side / 2 + right * facts.unit)] : null;
}

/** @param {Facts} facts @param {Goal} goal */
function goalName(facts, goal) {
  const found = named(facts, goal), place = placeOf(facts, goal);
  const what = found.length === facts.achievements.length ? "all achievements" : found.map((one) => facts.achievements[one]).join(" + ") || "none";
  return place ? `${what} at (${place[0]}, ${place[1]})` : what;
}

/** What was unlocked, and where. @param {Moment[]} moments @returns {Unlock[]} */
const unlocksOf = (moments) => moments.flatMap(({ row, column, unlocked: goal }, step) => (goal < 0 ? [] : [{ step, goal, home: [row, column] }]));

/** The cells that goals name, each with the numbers of its goals. @type {(facts: Facts, goals: Goal[]) => { home: [number, number], numbers: number[] }[]} */
function placesOf(facts, goals) {
  /** @type {Map<string, { home: [number, number], numbers: number[] }>} */
  const found = new Map();
  goals.forEach((goal, i) => {
    const home = placeOf(facts, goal);
    if (!home) return;
    const place = found.get(String(home)) ?? { home, numbers: [] };
    place.numbers.push(i + 1);
    found.set(String(home), place);
  });
  return [...found.values()];
}

/** The numbers of goals at one cell as a short label, such as "2–4,7"; "2,.." stands for many. @param {number[]} numbers */
function joined(numbers) {
  /** @type {number[][]} */
  const runs = [];
  for (const number of numbers) {
    const last = runs[runs.length - 1];
    if (last && last[last.length - 1] === number - 1) last.push(number);
    else runs.push([number]);
  }
  const texts = runs.map((run) => (run.length === 1 ? `${run[0]}` : `${run[0]}\u2013${run[run.length - 1]}`));
  return texts.length < 3 ? texts.join(",") : `${texts[0]},..`;
}

/** The marks of a map, moved aside so that they do not cover each other. @param {Facts} facts @param {Goal[]} goals @param {Moment[]} moments @returns {Mark[]} */
function marksOf(facts, goals, moments) {
  /** @type {Mark[]} */
  const marks = [];
  /** @type {(home: [number, number], label: string, color: string, isBox: boolean) => void} */
  function put([row, column], label, color, isBox) {
    const half = isBox ? MARK * Math.max(0.9, 0.32 * label.length + 0.3) : MARK;
    /** @type {[number, number]} */
    let center = [row, column];
    const covers = (/** @type {Mark} */ other) =>
      Math.hypot(other.center[0] - center[0], (2 * MARK * (other.center[1] - center[1])) / (half + other.half)) < 2.1 * MARK;
    for (let turn = 0; turn < 600 && marks.some(covers); turn++)
      center = [row + 0.13 * turn * Math.sin(0.7 * turn), column + 0.13 * turn * Math.cos(0.7 * turn)];
    marks.push({ home: [row, column], center, label, color, half, isBox });
  }
  if (moments.length) put([moments[0].row, moments[0].column], "S", PAPER, true);
  unlocksOf(moments).forEach(({ goal, home }, i) => put(home, String(i + 1), facts.achievementColors[goal], false));
  for (const { home, numbers } of placesOf(facts, goals)) put(home, joined(numbers), facts.promptColor, true);
  return marks;
}

/** @type {WorldDrawing["draw"]} */
function draw(context, facts, { task, goals, moments, earlier }, colors) {
  drawMap(context, facts, task);
  drawVisits(context, facts, earlier ?? [], colors);
  drawWay(context, moments);
  const marks = marksOf(facts, goals, moments);
  context.strokeStyle = INK;
  context.lineWidth = 0.18;
  for (const { home, center } of marks) {
    context.beginPath();
    context.moveTo(home[1] + 0.5, home[0] + 0.5);
    context.lineTo(center[1] + 0.5, center[0] + 0.5);
    context.stroke();
  }
  for (const each of marks) drawMark(context, each);
  if (!moments.length) return;
  const last = moments[moments.length - 1];
  context.beginPath();
  context.arc(last.column + 0.5, last.row + 0.5, 0.6, 0, 7);
  context.fillStyle = colors.agent;
  context.fill();
  context.strokeStyle = PAPER;
  context.lineWidth = 0.25;
  context.stroke();
}

/** Cells of one kind that lie side by side are drawn at once, a cell too far, which the next ones cover: no seams. @param {CanvasRenderingContext2D} context @param {Facts} facts @param {Task} task */
function drawMap(context, facts, task) {
  task.forEach((line, row) => {
    for (let column = 0; column < line.length; ) {
      let end = column + 1;
      while (line[end] === line[column]) end++;
      context.fillStyle = facts.blockColors[line.charCodeAt(column) - 97];
      context.fillRect(column, row, Math.min(end + 1, facts.side) - column, Math.min(row + 2, facts.side) - row);
      column = end;
    }
  });
}

/** Cells that episodes visited, darker the more often. @param {CanvasRenderingContext2D} context @param {Facts} facts @param {Moment[][]} walks @param {Colors} colors */
function drawVisits(context, { side }, walks, colors) {
  /** @type {Map<number, number>} */
  const visits = new Map();
  for (const { row, column } of walks.flat()) visits.set(row * side + column, (visits.get(row * side + column) ?? 0) + 1);
  const most = Math.max(1, ...visits.values());
  context.fillStyle = colors.visit;
  for (const [cell, count] of visits) {
    context.globalAlpha = 0.2 + 0.7 * Math.sqrt(count / most);
    context.fillRect(cell % side, Math.floor(cell / side), 1, 1);
  }
  context.globalAlpha = 1;
}

/** The way, from white to orange in time. @param {CanvasRenderingContext2D} context @param {Moment[]} moments */
function drawWay(context, moments) {
  context.lineCap = "round";
  for (const isRim of [true, false]) {
    context.lineWidth = isRim ? 0.7 : 0.4;
    for (let i = 1; i < moments.length; i++) {
      const [from, to] = [moments[i - 1], moments[i]];
      if (from.row === to.row && from.column === to.column) continue;
      const late = i / moments.length;
      context.strokeStyle = isRim ? INK : `rgb(${Math.round(255 - 25 * late)}, ${Math.round(255 - 96 * late)}, ${Math.round(255 - 255 * late)})`;
      context.beginPath();
      context.moveTo(from.column + 0.5, from.row + 0.5);
      context.lineTo(to.column + 0.5, to.row + 0.5);
      context.stroke();
    }
  }
}

/** A labeled disc or box. @param {CanvasRenderingContext2D} context @param {Mark} mark */
function drawMark(context, { center: [row, column], label, color, half, isBox }) {
  context.beginPath();
  if (isBox) context.roundRect(column + 0.5 - half, row + 0.5 - 0.9 * MARK, 2 * half, 1.8 * MARK, 0.4);
  else context.arc(column + 0.5, row + 0.5, MARK, 0, 7);
  context.fillStyle = color;
  context.fill();
  context.strokeStyle = isBox ? INK : PAPER;
  context.lineWidth = 0.16;
  context.stroke();
  context.fillStyle = isLight(color) ? INK : PAPER;
  context.font = `bold ${(label.length > 1 ? 1.4 : 1.7) * (MARK / 1.25)}px sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(label, column + 0.5, row + 0.6);
}

/** Whether dark letters can be read on a color better than light ones. @param {string} color as #rrggbb */
function isLight(color) {
  const [red, green, blue] = [1, 3, 5].map((at) => parseInt(color.slice(at, at + 2), 16) / 255);
  return 0.299 * red + 0.587 * green + 0.114 * blue > 0.6;
}

/** @type {WorldDrawing} */
export const world = {
  goalName,
  size: ({ side }) => [side, side],
  draw,
  tell(facts, { moments }) {
    const last = moments[moments.length - 1];
    if (!last) return `Map of ${facts.side} by ${facts.side} cells.`;
    const unlocked = unlocksOf(moments).map(({ step, goal }) => `${facts.achievements[goal]} in step ${step}`);
    return `Map of ${facts.side} by ${facts.side} cells. Agent at row ${last.row}, column ${last.column} after ${moments.length - 1} steps. ` +
      `Unlocked: ${unlocked.join(", ") || "nothing"}.`;
  },
  legend: (facts) => [
    ["start", "S: start, on the map as it was then"],
    ["agent", "agent at the end; its way from white to orange"],
    ...facts.kinds.map((/** @type {[string, string]} */ [kind, color], /** @type {number} */ i) => [color, i ? kind : `discs 1, 2, ..: achievements, where they were unlocked; ${kind}`]),
    ...(facts.places ? [[facts.promptColor, "boxes 1, 2, ..: goals of the prompt, at the places that they name"]] : []),
  ],
  moments: (rows) => rows.map(([row, column, unlocked]) => ({ row, column, unlocked: unlocked - 1 })),
};
