// Crafter for HTML pages: the map of a world at its start, with the way of an agent and what it unlocked.

/**
 * @typedef {{ side: number, unit: number, achievements: string[], achievementColors: string[], blocks: string[],
 *   blockColors: string[] }} Facts
 * @typedef {string[]} Task rows of letters, one for each block; a is the first kind
 * @typedef {{ row: number, column: number, unlocked: number }} Moment unlocked: the achievement of this moment, or -1
 * @typedef {{ step: number, goal: number, home: [number, number], center: [number, number] }} Unlock places as (row, column)
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

/** What was unlocked, with places for marks that do not cover each other. @param {Moment[]} moments @returns {Unlock[]} */
function unlocksOf(moments) {
  /** @type {Unlock[]} */
  const found = [];
  const first = moments[0], taken = first ? [[first.row, first.column]] : [];
  moments.forEach(({ row, column, unlocked: goal }, step) => {
    if (goal < 0) return;
    /** @type {[number, number]} */
    let center = [row, column];
    for (let turn = 0; turn < 400 && taken.some(([r, c]) => Math.hypot(r - center[0], c - center[1]) < 2.1 * MARK); turn++)
      center = [row + 0.13 * turn * Math.sin(0.7 * turn), column + 0.13 * turn * Math.cos(0.7 * turn)];
    taken.push(center);
    found.push({ step, goal, home: [row, column], center });
  });
  return found;
}

/** @type {WorldDrawing["draw"]} */
function draw(context, facts, { task, goals, moments, earlier }, colors) {
  drawMap(context, facts, task);
  drawVisits(context, facts, earlier ?? [], colors);
  drawWay(context, moments);
  goals.forEach((goal, i) => {
    const place = placeOf(facts, goal);
    if (place) mark(context, place, String(i + 1), colors.prompt, colors.onDisc);
  });
  if (!moments.length) return;
  const unlocks = unlocksOf(moments);
  context.strokeStyle = INK;
  context.lineWidth = 0.18;
  for (const { home, center } of unlocks) {
    context.beginPath();
    context.moveTo(home[1] + 0.5, home[0] + 0.5);
    context.lineTo(center[1] + 0.5, center[0] + 0.5);
    context.stroke();
  }
  mark(context, [moments[0].row, moments[0].column], "S", PAPER, INK);
  unlocks.forEach(({ goal, center }, i) => mark(context, center, String(i + 1), facts.achievementColors[goal], INK));
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

/** A labeled disc. @param {CanvasRenderingContext2D} context @param {[number, number]} place @param {string} label @param {string} color @param {string} ink */
function mark(context, [row, column], label, color, ink) {
  context.beginPath();
  context.arc(column + 0.5, row + 0.5, MARK, 0, 7);
  context.fillStyle = color;
  context.fill();
  context.strokeStyle = INK;
  context.lineWidth = 0.16;
  context.stroke();
  context.fillStyle = ink;
  context.font = `bold ${(label.length > 1 ? 1.4 : 1.7) * (MARK / 1.25)}px sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(label, column + 0.5, row + 0.6);
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
  legend: [
    ["start", "S: start, on the map as it was then"],
    ["agent", "agent at the end; its way from white to orange"],
    ["target", "1, 2, ..: achievements, where they were unlocked"],
  ],
  moments: (rows) => rows.map(([row, column, unlocked]) => ({ row, column, unlocked: unlocked - 1 })),
};
