// Types that the pages share. They are checked by `tsc -p experiments/pages`, and are in no page.

/** A goal in the numbers that the policy gets. */
type Goal = Float32Array;

/** A cell or another place that can be chosen on the drawing. */
type Spot = { row: number; column: number };

/** What the agent is told after a reset or a step; `envs/base.py:TimeStep`. */
interface TimeStep {
  obs: Float32Array;
  achieved: Goal;
  reached: boolean;
  outcome: Goal;
  reward: number;
  done: boolean;
}

/** An episode in progress, by the rules of a world. */
interface Play {
  readonly done: boolean;
  readonly return_: number;
  readonly numSteps: number;
  reset(start: ArrayLike<number> | null): TimeStep;
  step(action: number): TimeStep;
  /** What the drawing needs of this moment. */
  moment(): any;
}

/** What there is to draw. */
interface Scene {
  task: any;
  /** The goals of the prompt in their order; the last is usually the task goal. */
  goals: Goal[];
  /** Moments from the start of the episode until now. */
  moments: any[];
  /** Moments of earlier episodes, to count visits. */
  earlier?: any[][];
  /** Draw only what the moments have seen. */
  onlySeen?: boolean;
  /** What a search has seen, to be drawn in the place of everything else of the task. */
  known?: Known;
  /** Where the keyboard is. */
  cursor?: Spot | null;
}

/** The map of a search: goals that stand for states. */
interface Known {
  goals: Goal[];
  /** How often each was visited. */
  visits: number[];
  /** The shortest known way to the task goal, without its start. */
  way: Goal[];
}

/** Colors by name, for the light or the dark page. */
type Colors = Record<string, string>;

/** What a world brings to the report: how it is drawn. */
interface WorldDrawing {
  /** A goal in a few characters. */
  goalName(facts: any, goal: Goal): string;
  /** Width and height in units of the drawing. */
  size(facts: any): [number, number];
  draw(context: CanvasRenderingContext2D, facts: any, scene: Scene, colors: Colors): void;
  /** What the drawing shows, for those who do not see it. */
  tell(facts: any, scene: Scene): string;
  /** What the marks of the drawing mean: each has the name of a color of the page, or a color as #rrggbb. */
  legend: [string, string][] | ((facts: any) => [string, string][]);
  /** What the marks of a drawing of `known` mean, for a world that draws it. */
  legendOfKnown?: [string, string][];
  /** An episode in progress, for a world whose rules are in the script. */
  play?(facts: any, task: any): Play;
  /** The moments of an episode from what `Page.track` says of them, for a world whose rules are not. */
  moments?(rows: number[][]): any[];
}

/** What a world brings that also has a playground. */
interface WorldPage extends WorldDrawing {
  /** Names of the actions. */
  actions: string[];
  play(facts: any, task: any): Play;
  taskGoal(facts: any, task: any): Goal;
  /** Whether the drawing can be of what was seen only. */
  hidesUnseen: boolean;
  /** The spots that can be chosen: rows and columns. */
  spots(facts: any): [number, number];
  /** What is at a spot in a few words, for those who do not see it. */
  tellSpot?(facts: any, task: any, spot: Spot): string;
  /** The goal that a spot stands for. */
  goalAt(facts: any, task: any, spot: Spot): Goal | null;
  /** A new random task. */
  sampleTask(facts: any, random: () => number): any;
  /** The best return of any policy, or NaN. */
  optimum(facts: any, task: any): number;
  /** Further ways to change a task at a spot. */
  edits: Edit[];
}

interface Edit {
  name: string;
  /** Whether it goes on while the pointer is held down. */
  paints: boolean;
  /** The changed task, or null if that is not possible; `first` is the value of the first spot painted. */
  change(facts: any, task: any, spot: Spot, painted: boolean): any;
  /** What painting from this spot on sets. */
  paint?(facts: any, task: any, spot: Spot): boolean;
}
