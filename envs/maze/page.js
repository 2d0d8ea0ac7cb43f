// MazeRunner for HTML pages: the rules of envs/maze/env.py, and mazes with visits, paths and prompts.

const MOVES = [[0, -1], [-1, 0], [0, 1], [1, 0], [0, 0]];

/**
 * @typedef {{ side: number, horizon: number, start: number[], stepPenalty: number, goalReward: number }} Facts
 * @typedef {{ rows: string[], goal: number[] }} Task
 * @typedef {{ row: number, column: number, rays: number[] }} Moment
 */

/** @type {(task: Task, row: number, column: number) => boolean} */
const isWall = (task, row, column) => task.rows[row]?.[column] !== ".";

/** A cell in the numbers of a goal. @type {(facts: Facts, row: number, column: number) => Goal} */
const goalOf = (facts, row, column) => Float32Array.of(row / facts.side, column / facts.side);

/** The cell nearest to a goal, or null outside of the maze. @type {(facts: Facts, goal: Goal) => Spot | null} */
function cellOf(facts, goal) {
  const [row, column] = Array.from(goal, (part) => Math.round(part * facts.side));
  const inside = row >= 0 && column >= 0 && row < facts.side && column < facts.side;
  return inside ? { row, column } : null;
}

/** How many free cells lie to the west, north, east and south before the first wall. */
function freeCells(/** @type {Task} */ task, /** @type {number} */ row, /** @type {number} */ column) {
  return MOVES.slice(0, 4).map(([down, right]) => {
    let count = 0;
    while (!isWall(task, row + (count + 1) * down, column + (count + 1) * right)) count++;
    return count;
  });
}

/** One episode. @implements {Play} */
class Maze {
  /** @param {Facts} facts @param {Task} task */
  constructor(facts, task) {
    this.facts = facts;
    this.task = task;
    this.row = this.column = this.numSteps = this.return_ = 0;
    this.done = false;
    /** @type {number[]} */
    this.rays = [];
    this.reset();
  }

  reset() {
    [this.row, this.column] = this.facts.start;
    this.numSteps = 0;
    this.return_ = 0;
    this.done = false;
    return this.observe(0);
  }

  /** @param {number} action */
  step(action) {
    if (this.done) return this.observe(0);
    const { facts, task } = this;
    const row = this.row + MOVES[action][0], column = this.column + MOVES[action][1];
    if (!isWall(task, row, column)) [this.row, this.column] = [row, column];
    const atGoal = this.row === task.goal[0] && this.column === task.goal[1];
    const reward = Math.fround((atGoal ? facts.goalReward : 0) - Math.fround(facts.stepPenalty));
    this.return_ = Math.fround(this.return_ + reward);
    this.numSteps++;
    this.done = atGoal || this.numSteps >= facts.horizon;
    return this.observe(reward);
  }

  /** @param {number} reward @returns {TimeStep} */
  observe(reward) {
    const { facts, row, column } = this;
    this.rays = freeCells(this.task, row, column);
    const goal = goalOf(facts, row, column);
    const obs = Float32Array.from([row, column, ...this.rays], (value) => value / facts.side);
    return { obs, achieved: goal, reached: true, outcome: goal, reward, done: this.done };
  }

  /** @returns {Moment} */
  moment() {
    return { row: this.row, column: this.column, rays: this.rays };
  }
}

/** Steps from the start to each cell, -1 where there is no way. @type {(facts: Facts, task: Task) => number[][]} */
function distances(facts, task) {
  const steps = task.rows.map((row) => Array.from(row, () => -1));
  const queue = [facts.start];
  steps[facts.start[0]][facts.start[1]] = 0;
  for (const [row, column] of queue)
    for (const [down, right] of MOVES.slice(0, 4)) {
      const next = [row + down, column + right];
      if (isWall(task, next[0], next[1]) || steps[next[0]][next[1]] >= 0) continue;
      steps[next[0]][next[1]] = steps[row][column] + 1;
      queue.push(next);
    }
  return steps;
}

/** The walls of `generate_maze` by its classic procedure. @type {(facts: Facts, random: () => number) => string[]} */
function randomWalls({ side }, random) {
  const half = side >> 1;
  const draw = (/** @type {number} */ below) => Math.floor(random() * below);
  const walls = Array.from({ length: side }, (_, row) =>
    Array.from({ length: side }, (_, column) => row % (side - 1) === 0 || column % (side - 1) === 0));
  for (let island = Math.floor(0.75 * half * half); island > 0; island--) {
    let [row, column] = [2 * draw(half + 1), 2 * draw(half + 1)];
    walls[row][column] = true;
    for (let look = Math.floor(0.75 * 10 * side); look > 0; look--) {
      const ways = MOVES.slice(0, 4).filter(([down, right]) => walls[row + 2 * down]?.[column + 2 * right] !== undefined);
      const [down, right] = ways[draw(ways.length)];
      if (walls[row + 2 * down][column + 2 * right]) continue;
      walls[row + down][column + right] = walls[row + 2 * down][column + 2 * right] = true;
      [row, column] = [row + 2 * down, column + 2 * right];
    }
  }
  for (let row = side - 5; row < side - 1; row++)
    for (let column = 1; column < side - 1; column++)
      walls[row][column] = row > side - 5 && (column === half - 1 || column === half + 1);
  return walls.map((row) => row.map((wall) => (wall ? "#" : ".")).join(""));
}

/** The task with one cell changed. @type {(task: Task, spot: Spot, wall: boolean) => Task} */
function withWall(task, { row, column }, wall) {
  const rows = [...task.rows];
  rows[row] = rows[row].slice(0, column) + (wall ? "#" : ".") + rows[row].slice(column + 1);
  return { ...task, rows };
}

/** @type {(facts: Facts, spot: Spot) => boolean} */
const isInside = ({ side }, { row, column }) => row > 0 && column > 0 && row < side - 1 && column < side - 1;

/** Cells that some moments have seen, walls next to them included. @type {(facts: Facts, moments: Moment[]) => Set<number>} */
function cellsSeen({ side }, moments) {
  const seen = new Set();
  for (const { row, column, rays } of moments)
    rays.forEach((count, way) => {
      for (let far = 0; far <= count + 1; far++)
        seen.add((row + far * MOVES[way][0]) * side + column + far * MOVES[way][1]);
    });
  return seen;
}

/** How often each cell was visited. @type {(facts: Facts, walks: Moment[][]) => Map<number, number>} */
function countVisits({ side }, walks) {
  const visits = new Map();
  for (const walk of walks)
    for (const { row, column } of walk)
      visits.set(row * side + column, (visits.get(row * side + column) ?? 0) + 1);
  return visits;
}

/** How often a search visited each cell that it knows. @type {(facts: Facts, known: Known) => Map<number, number>} */
function knownVisits(facts, { goals, visits }) {
  return new Map(goals.flatMap((goal, i) => {
    const cell = cellOf(facts, goal);
    return cell ? [[cell.row * facts.side + cell.column, visits[i]]] : [];
  }));
}

/** @type {WorldPage["draw"]} */
function draw(context, facts, { task, goals, moments, earlier, onlySeen, known, cursor }, colors) {
  const { side } = facts;
  const visits = known ? knownVisits(facts, known) : countVisits(facts, earlier ?? []), most = Math.max(1, ...visits.values());
  const seen = known ? new Set(visits.keys()) : onlySeen ? cellsSeen(facts, moments) : null;
  const inSight = earlier ? new Set() : cellsSeen(facts, moments.slice(-1));
  for (let row = 0; row < side; row++)
    for (let column = 0; column < side; column++) {
      const at = row * side + column, hidden = seen && !seen.has(at) && !(known && isWall(task, row, column));
      context.fillStyle = hidden ? colors.hidden : isWall(task, row, column) ? colors.wall : colors.free;
      context.fillRect(column, row, 1.02, 1.02);
      if (hidden || isWall(task, row, column)) continue;
      if (visits.has(at) || inSight.has(at)) {
        context.globalAlpha = visits.has(at) ? 0.15 + 0.7 * Math.sqrt((visits.get(at) ?? 0) / most) : 0.3;
        context.fillStyle = visits.has(at) ? colors.visit : colors.sight;
        context.fillRect(column, row, 1, 1);
        context.globalAlpha = 1;
      }
      context.strokeStyle = colors.line;
      context.lineWidth = 0.03;
      context.strokeRect(column, row, 1, 1);
    }
  drawWalk(context, moments, colors);
  if (known) drawWay(context, facts, known.way, colors);
  const unit = Math.max(1, side / 19);
  const [startRow, startColumn] = facts.start;
  mark(context, startColumn, startRow, "S", colors.start, colors, unit, true);
  goals.forEach((goal, index) => {
    const cell = cellOf(facts, goal);
    const isTarget = index === goals.length - 1 && cell?.row === task.goal[0] && cell?.column === task.goal[1];
    if (cell && !isTarget) mark(context, cell.column, cell.row, String(index + 1), colors.prompt, colors, unit, false);
  });
  mark(context, task.goal[1], task.goal[0], "T", colors.target, colors, unit, true);
  const last = moments[moments.length - 1];
  if (last) drawAgent(context, last, colors, unit);
  if (cursor) {
    context.strokeStyle = colors.focus;
    context.lineWidth = 0.14 * unit;
    context.strokeRect(cursor.column - 0.05, cursor.row - 0.05, 1.1, 1.1);
  }
}

/** @param {CanvasRenderingContext2D} context @param {Moment[]} moments @param {Colors} colors */
function drawWalk(context, moments, colors) {
  context.lineWidth = 0.17;
  context.lineCap = "round";
  context.strokeStyle = colors.agent;
  for (let i = 1; i < moments.length; i++) {
    context.globalAlpha = 0.35 + (0.65 * i) / moments.length;
    context.beginPath();
    context.moveTo(moments[i - 1].column + 0.5, moments[i - 1].row + 0.5);
    context.lineTo(moments[i].column + 0.5, moments[i].row + 0.5);
    context.stroke();
  }
  context.globalAlpha = 1;
}

/** A way from the start as a line with a pale rim. @param {CanvasRenderingContext2D} context @param {Facts} facts @param {Goal[]} way @param {Colors} colors */
function drawWay(context, facts, way, colors) {
  if (!way.length) return;
  context.beginPath();
  context.moveTo(facts.start[1] + 0.5, facts.start[0] + 0.5);
  for (const goal of way) {
    const cell = cellOf(facts, goal);
    if (cell) context.lineTo(cell.column + 0.5, cell.row + 0.5);
  }
  context.lineCap = context.lineJoin = "round";
  for (const [color, width] of /** @type {[string, number][]} */ ([[colors.paper, 0.36], [colors.agent, 0.2]])) {
    context.strokeStyle = color;
    context.lineWidth = width;
    context.stroke();
  }
}

/** @param {CanvasRenderingContext2D} context @param {Moment} moment @param {Colors} colors @param {number} unit */
function drawAgent(context, { row, column }, colors, unit) {
  context.beginPath();
  context.arc(column + 0.5, row + 0.5, 0.27 * unit, 0, 7);
  context.fillStyle = colors.agent;
  context.strokeStyle = colors.paper;
  context.lineWidth = 0.1;
  context.fill();
  context.stroke();
}

/**
 * A labeled disc or box in the middle of a cell.
 * @param {CanvasRenderingContext2D} context @param {number} column @param {number} row @param {string} label
 * @param {string} color @param {Colors} colors @param {number} unit @param {boolean} isBox
 */
function mark(context, column, row, label, color, colors, unit, isBox) {
  const radius = 0.44 * unit;
  context.beginPath();
  if (isBox) context.rect(column + 0.5 - radius, row + 0.5 - radius, 2 * radius, 2 * radius);
  else context.arc(column + 0.5, row + 0.5, radius, 0, 7);
  context.fillStyle = color;
  context.fill();
  context.strokeStyle = colors.markEdge;
  context.lineWidth = 0.06 * unit;
  context.stroke();
  context.fillStyle = isBox ? colors.onBox : colors.onDisc;
  context.font = `bold ${(label.length > 1 ? 0.5 : 0.64) * unit}px sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(label, column + 0.5, row + 0.5 + 0.04 * unit);
}

/** @type {WorldPage} */
export const world = {
  actions: ["west", "north", "east", "south", "stay"],
  play: (facts, task) => new Maze(facts, task),
  goalName(facts, goal) {
    const cell = cellOf(facts, goal);
    return cell ? `(${cell.row}, ${cell.column})` : "outside";
  },
  taskGoal: (facts, task) => goalOf(facts, task.goal[0], task.goal[1]),
  size: ({ side }) => [side, side],
  hidesUnseen: true,
  draw,
  tell(facts, { task, moments }) {
    const { row, column } = moments[moments.length - 1] ?? { row: facts.start[0], column: facts.start[1] };
    return `Maze of ${facts.side} by ${facts.side} cells. Target at row ${task.goal[0]}, column ${task.goal[1]}. ` +
      `Agent at row ${row}, column ${column} after ${Math.max(moments.length - 1, 0)} steps.`;
  },
  legend: [
    ["start", "S: start"],
    ["target", "T: target, the task goal"],
    ["prompt", "1, 2, ..: goals of the prompt in their order"],
    ["agent", "agent and its path"],
    ["wall", "wall"],
  ],
  legendOfKnown: [
    ["visit", "known, darker the more often it was visited"],
    ["hidden", "not known"],
    ["agent", "shortest known way"],
    ["prompt", "best prompt so far"],
  ],
  spots: ({ side }) => [side, side],
  tellSpot(facts, task, { row, column }) {
    const isAt = (/** @type {number[]} */ place) => place[0] === row && place[1] === column;
    return isAt(task.goal) ? "target" : isAt(facts.start) ? "start" : isWall(task, row, column) ? "wall" : "free";
  },
  goalAt: (facts, task, { row, column }) => (isInside(facts, { row, column }) ? goalOf(facts, row, column) : null),
  sampleTask(facts, random) {
    const rows = randomWalls(facts, random), task = { rows, goal: facts.start };
    const cells = distances(facts, task).flatMap((line, row) => line.map((steps, column) => ({ steps, row, column })));
    const reachable = cells.filter(({ steps }) => steps > 0 && steps <= facts.horizon);
    const { row, column } = reachable[Math.floor(random() * reachable.length)];
    return { rows, goal: [row, column] };
  },
  optimum(facts, task) {
    const steps = distances(facts, task)[task.goal[0]][task.goal[1]];
    return steps >= 0 && steps <= facts.horizon ? facts.goalReward - facts.stepPenalty * steps : -facts.stepPenalty * facts.horizon;
  },
  edits: [
    {
      name: "Move the target",
      paints: false,
      change(facts, task, spot) {
        const isStart = spot.row === facts.start[0] && spot.column === facts.start[1];
        return isWall(task, spot.row, spot.column) || isStart ? null : { ...task, goal: [spot.row, spot.column] };
      },
    },
    {
      name: "Draw walls",
      paints: true,
      paint: (_, task, { row, column }) => !isWall(task, row, column),
      change(facts, task, spot, wall) {
        const taken = [facts.start, task.goal].some(([row, column]) => row === spot.row && column === spot.column);
        return isInside(facts, spot) && !taken ? withWall(task, spot, wall) : null;
      },
    },
  ],
};
