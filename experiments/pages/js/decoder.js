// The policy: mgpo_jax/transformer.py step by step, with a key-value cache.
// Sums are in double precision, what is kept is in single precision.

/**
 * @typedef {import("./arrays.js").Shaped} Shaped
 * @typedef {Record<string, Shaped>} Weights
 * @typedef {{ goal_dim: number, action_dim: number, horizon: number, max_prompt_length: number, embed_dim: number,
 *   num_layers: number, num_heads: number, obs_mean: number[], obs_std: number[] }} Network
 */

const EPSILON = 1e-6; // of a LayerNorm, as in Flax
const OBS_LIMIT = 5; // standard deviations

/** A linear layer. Its matrix is stored by output, so that an output is one sum over neighbors in memory. */
class Dense {
  /** @param {Weights} weights @param {string} name */
  constructor(weights, name) {
    const { data, shape } = weights[`${name}/kernel`];
    this.numIn = shape[0];
    this.numOut = shape[1];
    /** @type {Float32Array} */
    this.bias = weights[`${name}/bias`].data;
    this.matrix = new Float32Array(data.length);
    for (let i = 0; i < this.numIn; i++)
      for (let j = 0; j < this.numOut; j++) this.matrix[j * this.numIn + i] = data[i * this.numOut + j];
  }

  /** Four outputs at a time: twice as fast as one by one. @param {ArrayLike<number>} x */
  apply(x) {
    const { matrix, bias, numIn, numOut } = this, y = new Float32Array(numOut);
    let j = 0;
    for (; j + 4 <= numOut; j += 4) {
      const a = j * numIn, b = a + numIn, c = b + numIn, d = c + numIn;
      let sumA = bias[j], sumB = bias[j + 1], sumC = bias[j + 2], sumD = bias[j + 3];
      for (let i = 0; i < numIn; i++) {
        const value = x[i];
        sumA += value * matrix[a + i];
        sumB += value * matrix[b + i];
        sumC += value * matrix[c + i];
        sumD += value * matrix[d + i];
      }
      y[j] = sumA;
      y[j + 1] = sumB;
      y[j + 2] = sumC;
      y[j + 3] = sumD;
    }
    for (; j < numOut; j++) {
      let sum = bias[j];
      for (let i = 0; i < numIn; i++) sum += x[i] * matrix[j * numIn + i];
      y[j] = sum;
    }
    return y;
  }
}

/** A LayerNorm; the variance is E[x^2] - E[x]^2, as in Flax. */
class Norm {
  /** @param {Weights} weights @param {string} name */
  constructor(weights, name) {
    /** @type {Float32Array} */
    this.scale = weights[`${name}/scale`].data;
    /** @type {Float32Array} */
    this.bias = weights[`${name}/bias`].data;
  }

  /** @param {Float32Array} x */
  apply(x) {
    let sum = 0, squares = 0;
    for (const value of x) {
      sum += value;
      squares += value * value;
    }
    const mean = sum / x.length, variance = Math.max(squares / x.length - mean * mean, 0);
    const factor = 1 / Math.sqrt(variance + EPSILON);
    return x.map((value, i) => (value - mean) * factor * this.scale[i] + this.bias[i]);
  }
}

/** One block with the keys and values of the tokens that it has seen. */
class Block {
  /** @param {Weights} weights @param {string} name @param {Network} network */
  constructor(weights, name, network) {
    const dense = (/** @type {string} */ part) => new Dense(weights, `${name}/${part}`);
    this.query = dense("query");
    this.keyValue = dense("key_value");
    this.mix = dense("mix");
    this.expand = dense("expand");
    this.contract = dense("contract");
    this.normAttention = new Norm(weights, `${name}/norm_attention`);
    this.normMlp = new Norm(weights, `${name}/norm_mlp`);
    this.width = network.embed_dim;
    this.numHeads = network.num_heads;
    const numTokens = network.max_prompt_length + 2 * network.horizon;
    this.cache = new Float32Array(numTokens * 2 * this.width); // of each token its keys, then its values
    this.scores = new Float64Array(numTokens);
  }

  /**
   * Read token number `at`. Without a reader it leaves keys and values only.
   * @param {Float32Array} x @param {number} at @param {boolean} isRead
   */
  apply(x, at, isRead) {
    const h = this.normAttention.apply(x);
    this.cache.set(this.keyValue.apply(h), at * 2 * this.width);
    if (!isRead) return x;
    const mixed = this.mix.apply(this.attend(this.query.apply(h), at + 1));
    const y = x.map((value, i) => value + mixed[i]);
    const inner = this.expand.apply(this.normMlp.apply(y)).map((value) => Math.max(value, 0));
    const out = this.contract.apply(inner);
    return y.map((value, i) => value + out[i]);
  }

  /** @param {Float32Array} query @param {number} numSeen */
  attend(query, numSeen) {
    const { cache, scores, width, numHeads } = this;
    const size = width / numHeads, mixed = new Float32Array(width);
    for (let from = 0; from < width; from += size) {
      let largest = -Infinity, total = 0;
      for (let s = 0; s < numSeen; s++) {
        const key = s * 2 * width + from;
        let sum = 0;
        for (let i = 0; i < size; i++) sum += query[from + i] * cache[key + i];
        scores[s] = sum / Math.sqrt(size);
        largest = Math.max(largest, scores[s]);
      }
      for (let s = 0; s < numSeen; s++) total += scores[s] = Math.exp(scores[s] - largest);
      for (let i = 0; i < size; i++) {
        let sum = 0;
        for (let s = 0; s < numSeen; s++) sum += scores[s] * cache[(s * 2 + 1) * width + from + i];
        mixed[from + i] = sum / total;
      }
    }
    return mixed;
  }
}

/** The policy in one episode. */
export class Policy {
  /** @param {Network} network @param {Weights} weights */
  constructor(network, weights) {
    this.network = network;
    /** @type {Float32Array} */
    this.time = weights.embed_time.data;
    /** @type {Float32Array | undefined} */
    this.slot = weights.embed_slot?.data;
    this.embedGoal = new Dense(weights, "embed_goal");
    this.embedObs = new Dense(weights, "embed_obs");
    this.embedAction = new Dense(weights, "embed_action");
    this.head = new Dense(weights, "head");
    this.normIn = new Norm(weights, "norm_in");
    this.normOut = new Norm(weights, "norm_out");
    this.blocks = Array.from({ length: network.num_layers }, (_, i) => new Block(weights, `blocks_${i}`, network));
    this.numTokens = this.numSteps = 0;
  }

  /** Begin an episode. Goals fill the last slots; nobody sees the empty ones, which are left out. @param {Goal[]} goals */
  begin(goals) {
    this.numTokens = this.numSteps = 0;
    const empty = this.network.max_prompt_length - goals.length;
    goals.forEach((goal, i) => this.read(this.token(this.embedGoal.apply(goal), this.slot, empty + i), false));
  }

  /** The logits of the next action. @param {Float32Array} obs */
  observe(obs) {
    const { obs_mean: means, obs_std: spreads } = this.network;
    const seen = means.length
      ? obs.map((value, i) => Math.max(-OBS_LIMIT, Math.min(OBS_LIMIT, (value - means[i]) / spreads[i])))
      : obs;
    const x = this.read(this.token(this.embedObs.apply(seen), this.time, this.numSteps), true);
    return this.head.apply(this.normOut.apply(x));
  }

  /** Tell which action was taken; it has the time of the observation before it. @param {number} action */
  act(action) {
    const oneHot = new Float32Array(this.network.action_dim);
    oneHot[action] = 1;
    this.read(this.token(this.embedAction.apply(oneHot), this.time, this.numSteps++), false);
  }

  /** @param {Float32Array} x @param {Float32Array | undefined} table @param {number} row */
  token(x, table, row) {
    return this.normIn.apply(table ? x.map((value, i) => value + table[row * x.length + i]) : x);
  }

  /** In the last layer only observations are read out. @param {Float32Array} x @param {boolean} isObs */
  read(x, isObs) {
    const at = this.numTokens++, last = this.blocks.length - 1;
    this.blocks.forEach((block, i) => (x = block.apply(x, at, i < last || isObs)));
    return x;
  }
}

/** Probabilities of logits. @type {(logits: ArrayLike<number>) => number[]} */
export function softmax(logits) {
  const largest = Math.max(...Array.from(logits));
  const weights = Array.from(logits, (value) => Math.exp(value - largest));
  const total = weights.reduce((a, b) => a + b);
  return weights.map((value) => value / total);
}

/** The first of the largest. @type {(values: ArrayLike<number>) => number} */
export function argmax(values) {
  let best = 0;
  for (let i = 1; i < values.length; i++) if (values[i] > values[best]) best = i;
  return best;
}
