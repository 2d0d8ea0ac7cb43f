// GridWorld for HTML pages: the rules of envs/gridworld/env.py, and the grid with its objects.

const MOVES = [[0, -1], [-1, 0], [0, 1], [1, 0], [0, 0], [0, 0]];
const FLIP = 5;

/**
 * @typedef {{ side: number, horizon: number, objects: number[][], letters: string, fewest: number }} Facts
 * @typedef {number[]} Task the objects in their order
 * @typedef {{ row: number, column: number, isOn: boolean[], numSolved: number }} Moment
 */

/** @type {(facts: Facts, things: number[]) => Goal} */
const goalOf = (facts, things) => Float32Array.from(facts.objects, (_, thing) => +things.includes(thing));

/** The objects that a goal names. @type {(goal: Goal) => number[]} */
const thingsOf = (goal) => Array.from(goal.keys()).filter((thing) => goal[thing] > 0.5);

/** The object in a cell, or -1. @type {(facts: Facts, spot: Spot) => number} */
const thingAt = ({ objects }, spot) => objects.findIndex(([row, column]) => row === spot.row && column === spot.column);

/** One episode. @implements {Play} */
class Grid {
  /** @param {Facts} facts @param {Task} task */
  constructor(facts, task) {
    this.facts = facts;
    this.task = task;
    this.row = this.column = this.numSteps = this.numSolved = this.return_ = 0;
    this.newlyOn = -1;
    this.done = false;
    /** @type {boolean[]} */
    this.isOn = [];
    /** @type {boolean[]} */
    this.wasOn = [];
    this.reset(null);
  }

  /** @param {ArrayLike<number> | null} start */
  reset(start) {
    const draw = () => Math.floor(Math.random() * this.facts.side);
    [this.row, this.column] = start ? [start[0], start[1]] : [draw(), draw()];
    this.isOn = this.facts.objects.map(() => false);
    this.wasOn = [...this.isOn];
    this.newlyOn = -1;
    this.numSolved = this.numSteps = this.return_ = 0;
    this.done = false;
    return this.observe(0);
  }

  /** @param {number} action */
  step(action) {
    this.newlyOn = -1;
    if (this.done) return this.observe(0);
    const { facts, task } = this, { side } = facts;
    const here = thingAt(facts, this);
    if (action === FLIP && here >= 0) {
      this.isOn[here] = !this.isOn[here];
      if (!this.wasOn[here]) this.newlyOn = here;
      this.wasOn[here] = true;
    }
    const inOrder = task.every((thing, place) => this.isOn[thing] === place <= this.numSolved);
    const reward = inOrder ? Math.fround(1 / task.length) : 0;
    this.numSolved += +inOrder;
    const clip = (/** @type {number} */ at) => Math.min(Math.max(at, 0), side - 1);
    this.row = clip(this.row + MOVES[action][0]);
    this.column = clip(this.column + MOVES[action][1]);
    this.numSteps++;
    this.return_ = Math.fround(this.return_ + reward);
    this.done = this.numSolved >= task.length || this.numSteps >= facts.horizon;
    return this.observe(reward);
  }

  /** @param {number} reward @returns {TimeStep} */
  observe(reward) {
    const { facts, newlyOn, wasOn } = this;
    return {
      obs: Float32Array.from([...this.isOn.map(Number), this.row, this.column]),
      achieved: goalOf(facts, newlyOn < 0 ? [] : [newlyOn]),
      reached: newlyOn >= 0,
      outcome: Float32Array.from(wasOn, Number),
      reward,
      done: this.done,
    };
  }

  /** @returns {Moment} */
  moment() {
    return { row: this.row, column: this.column, isOn: [...this.isOn], numSolved: this.numSolved };
  }
}

/** The objects that were switched, on or off, in this order. @type {(moments: Moment[]) => number[]} */
const switchesOf = (moments) => moments.slice(1).flatMap(({ isOn }, i) =>
  isOn.flatMap((on, thing) => (on === moments[i].isOn[thing] ? [] : [thing])));

/** @type {WorldPage["draw"]} */
function draw(context, facts, { task, goals, moments, earlier, cursor }, colors) {
  const { side, objects, letters } = facts;
  const visits = new Map();
  for (const { row, column } of (earlier ?? []).flat())
    visits.set(row * side + column, (visits.get(row * side + column) ?? 0) + 1);
  const most = Math.max(1, ...visits.values());
  for (let row = 0; row < side; row++)
    for (let column = 0; column < side; column++) {
      const count = visits.get(row * side + column);
      context.fillStyle = colors.free;
      context.fillRect(column, row, 1, 1);
      if (count) {
        context.globalAlpha = 0.1 + 0.6 * Math.sqrt(count / most);
        context.fillStyle = colors.visit;
        context.fillRect(column, row, 1, 1);
        context.globalAlpha = 1;
      }
      context.strokeStyle = colors.line;
      context.lineWidth = 0.03;
      context.strokeRect(column, row, 1, 1);
    }
  context.lineWidth = 0.1;
  context.lineCap = "round";
  context.strokeStyle = colors.agent;
  let lane = 0;
  for (let i = 1; i < moments.length; i++) {
    const [from, to] = [moments[i - 1], moments[i]];
    if (from.isOn.some((/** @type {boolean} */ on, /** @type {number} */ thing) => on !== to.isOn[thing])) lane++;
    const shift = 0.5 + 0.12 * ((lane % 5) - 2);
    context.globalAlpha = 0.3 + (0.7 * i) / moments.length;
    context.beginPath();
    context.moveTo(from.column + shift, from.row + shift);
    context.lineTo(to.column + shift, to.row + shift);
    context.stroke();
  }
  context.globalAlpha = 1;
  const last = moments[moments.length - 1], switched = switchesOf(moments);
  objects.forEach((/** @type {number[]} */ [row, column], /** @type {number} */ thing) => {
    const place = task.indexOf(thing), isOn = Boolean(last?.isOn[thing]);
    context.beginPath();
    context.arc(column + 0.5, row + 0.5, place < 0 ? 0.32 : 0.42, 0, 7);
    context.fillStyle = isOn ? (place < 0 ? colors.hidden : colors.target) : colors.free;
    context.fill();
    context.strokeStyle = place < 0 ? colors.faint : colors.ink;
    context.lineWidth = 0.07;
    context.stroke();
    write(context, letters[thing], column + 0.5, row + 0.54, 0.5, isOn && place >= 0 ? colors.onBox : place < 0 && !isOn ? colors.faint : colors.ink);
    if (place >= 0) disc(context, column + 1.0, row - 0.0, String(place + 1), colors.ink, colors.free);
    const named = goals.flatMap((goal, i) => (thingsOf(goal).length === 1 && thingsOf(goal)[0] === thing ? [i + 1] : []));
    if (named.length) disc(context, column + 0.0, row - 0.0, named.join(","), colors.prompt, colors.onDisc);
    const turns = switched.flatMap((one, i) => (one === thing ? [i + 1] : []));
    if (turns.length) disc(context, column + 0.0, row + 1.0, turns.join(","), colors.agent, colors.onDisc);
  });
  if (moments.length) {
    const first = moments[0];
    context.strokeStyle = colors.ink;
    context.lineWidth = 0.06;
    context.strokeRect(first.column + 0.2, first.row + 0.2, 0.6, 0.6);
    ring(context, last.column + 0.5, last.row + 0.5, 0.56, colors.agent, 0.13);
  }
  if (cursor) {
    context.strokeStyle = colors.focus;
    context.lineWidth = 0.1;
    context.strokeRect(cursor.column + 0.03, cursor.row + 0.03, 0.94, 0.94);
  }
}

/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y @param {number} radius @param {string} color @param {number} width */
function ring(context, x, y, radius, color, width) {
  context.beginPath();
  context.arc(x, y, radius, 0, 7);
  context.strokeStyle = color;
  context.lineWidth = width;
  context.stroke();
}

/** @param {CanvasRenderingContext2D} context @param {number} x @param {number} y @param {string} label @param {string} color @param {string} ink */
function disc(context, x, y, label, color, ink) {
  context.beginPath();
  context.arc(x, y, 0.26, 0, 7);
  context.fillStyle = color;
  context.fill();
  write(context, label, x, y + 0.02, label.length > 2 ? Math.max(0.6 / label.length, 0.12) : 0.34, ink);
}

/** @param {CanvasRenderingContext2D} context @param {string} text @param {number} x @param {number} y @param {number} size @param {string} color */
function write(context, text, x, y, size, color) {
  context.fillStyle = color;
  context.font = `bold ${size}px sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(text, x, y);
}

/** @type {(items: number[], random: () => number) => number[]} */
function shuffled(items, random) {
  const left = [...items];
  return items.map(() => left.splice(Math.floor(random() * left.length), 1)[0]);
}

/** @type {WorldPage} */
export const world = {
  actions: ["west", "north", "east", "south", "stay", "switch"],
  play: (facts, task) => new Grid(facts, task),
  goalName(facts, goal) {
    return thingsOf(goal).map((thing) => facts.letters[thing]).join("") || "none";
  },
  taskGoal: (facts, task) => goalOf(facts, task),
  size: ({ side }) => [side, side],
  hidesUnseen: false,
  draw,
  tell(facts, { task, moments }) {
    const name = (/** @type {number} */ thing) => facts.letters[thing];
    const last = moments[moments.length - 1];
    if (!last) return `Grid with objects ${facts.letters}. True order ${task.map(name).join(", ")}.`;
    const on = last.isOn.flatMap((/** @type {boolean} */ isOn, /** @type {number} */ thing) => (isOn ? [name(thing)] : []));
    return `True order ${task.map(name).join(", ")}. Agent at row ${last.row}, column ${last.column} after ` +
      `${moments.length - 1} steps; switched: ${switchesOf(moments).map(name).join(", ") || "none"}; ` +
      `on: ${on.join(", ") || "none"}; ${last.numSolved} of ${task.length} in order.`;
  },
  legend: [
    ["target", "filled disc: switched on"],
    ["ink", "small number: position in the true order"],
    ["prompt", "number above: position in the prompt"],
    ["agent", "ring and line: agent and its path"],
    ["agent", "number below: when it was switched, on or off"],
  ],
  spots: ({ side }) => [side, side],
  tellSpot(facts, task, spot) {
    const thing = thingAt(facts, spot), place = task.indexOf(thing);
    if (thing < 0) return "empty";
    return `object ${facts.letters[thing]}, ${place < 0 ? "not in the true order" : `number ${place + 1} of the true order`}`;
  },
  goalAt(facts, _, spot) {
    const thing = thingAt(facts, spot);
    return thing < 0 ? null : goalOf(facts, [thing]);
  },
  sampleTask(facts, random) {
    const all = [...facts.objects.keys()];
    const num = facts.fewest + Math.floor(random() * (all.length - facts.fewest + 1));
    return shuffled(all, random).slice(0, num);
  },
  optimum: () => 1,
  edits: [],
};
