/* An environment in the page, and agents that act in it; nothing here draws or listens.
 *
 * The step comes as functions that Python printed (lag_envs/envs/scripted.py); no physics is written here.
 * Arrays are named as there: k constants, f one environment's row, a action, d draws in [0, 1), p poses.
 * Of the imperfections of sensors and actuators, scripts know drawn parameters, noise and delayed actions.
 *
 * In this order: random numbers, episodes, links, agents.
 */
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// --- random numbers --------------------------------------------------------------------------------------
// The same as lag_envs/stepping/primitives.py: SplitMix64's mix of key, step and index, in 64 bits. A word is
// kept as its two unsigned halves, since each BigInt would be garbage; results are left in `high` and `low`.

const big = (x) => BigInt(x);
const BITS = 64;
const HALF = 2 ** 32;
const PER_STEP = 16;
/** Keys of draws that are not the episode's own, as lag_envs/envs/imperfect/draws.py has them. */
const PURPOSES = { parameters: 1, observation: 2 };
let [high, low] = [0, 0];

/** The product of two words, modulo 2^64. */
function multiply(aHigh, aLow, bHigh, bLow) {
  const a0 = aLow & 0xffff;
  const a1 = aLow >>> 16;
  const b0 = bLow & 0xffff;
  const b1 = bLow >>> 16;
  const first = a0 * b0;
  const second = a1 * b0 + (first >>> 16);
  const third = a0 * b1 + (second & 0xffff);
  low = ((third << 16) | (first & 0xffff)) >>> 0;
  high = (a1 * b1 + (second >>> 16) + (third >>> 16) + Math.imul(aHigh, bLow) + Math.imul(aLow, bHigh)) >>> 0;
}

/** The word, with its upper bits mixed into the lower ones. */
function fold(by) {
  low = (low ^ ((low >>> by) | (high << (32 - by)))) >>> 0;
  high = (high ^ (high >>> by)) >>> 0;
}

function mix() {
  fold(30);
  multiply(high, low, 0xbf58476d, 0x1ce4e5b9);
  fold(27);
  multiply(high, low, 0x94d049bb, 0x133111eb);
  fold(31);
}

/** The mix of a key and a multiple of the golden ratio. */
function stir(keyHigh, keyLow, n) {
  multiply(Math.floor(n / HALF), n >>> 0, 0x9e3779b9, 0x7f4a7c15);
  const sum = low + keyLow;
  low = sum >>> 0;
  high = (high + keyHigh + (sum >= HALF ? 1 : 0)) >>> 0;
  mix();
}

/** The key of an episode, as its two halves. */
function episodeKey(key, episode) {
  [high, low] = key;
  mix();
  stir(high, low, episode);
  return [high, low];
}

const halves = (word) => [Number(big(word) >> big(32)), Number(BigInt.asUintN(32, big(word)))];

/** Draw `index` of step `step`, in [0, 1). */
function uniform(key, step, index) {
  stir(key[0], key[1], step * PER_STEP + index + 1);
  return (high * 2 ** 21 + (low >>> 11)) * 2 ** -53;
}

// --- episodes --------------------------------------------------------------------------------------------

/** Room for the poses of all frames, [x, y, angle, part] each. */
const roomOf = ({ frames }) => Array.from({ length: frames }, () => [0, 0, 0, 0]);

/** An environment, stepped by the printed functions. A step makes no arrays: garbage costs more than the step. */
class Episode {
  constructor(code, seed, constants = code.constants) {
    const { about } = code;
    this.code = code;
    this.k = Float64Array.from(constants);
    this.f = new Float64Array(about.size);
    this.kept = new Float64Array(about.size);
    this.p = new Float64Array(4 * about.frames);
    this.d = new Float64Array(Math.max(about.starts, about.draws, about.drawn, about.noise));
    this.o = this.part("o");
    this.state = this.f.subarray(0, about.states);
    /** What agents see: the observation in float32. */
    this.seen = new Float64Array(this.o.length);
    this.waiting = Array.from({ length: about.delay + 1 }, () => new Float64Array(about.rest.length));
    this.restart(seed);
  }

  restart(seed) {
    const { functions, about } = this.code;
    this.key = episodeKey(halves(seed), 1);
    this.noise = episodeKey(this.key, PURPOSES.observation);
    [this.steps, this.total, this.over] = [0, 0, ""];
    for (const action of this.waiting) action.set(about.rest);
    if (about.drawn) {
      functions.draw(this.k, this.draws(about.drawn, episodeKey(this.key, PURPOSES.parameters), 0));
      functions.derive(this.k);
    }
    functions.start(this.f, this.draws(about.starts, this.key, 0), this.k);
    this.observe();
  }

  /** Draws of a step. */
  draws(count, key, step) {
    for (let i = 0; i < count; i++) this.d[i] = uniform(key, step, i);
    return this.d;
  }

  observe() {
    const { functions, about } = this.code;
    functions.observe(this.f, this.k);
    if (functions.sense) {
      const step = this.steps * Math.ceil(about.noise / PER_STEP);
      functions.sense(this.f, this.draws(about.noise, this.noise, step), this.k);
    }
    for (let i = 0; i < this.seen.length; i++) this.seen[i] = Math.fround(this.o[i]);
  }

  /** Hold an action for one interval; returns the reward. Afterwards `over` says how it ended, if it did. */
  step(action) {
    const { functions, about } = this.code;
    const { rows } = about;
    this.kept.set(this.f);
    const many = this.waiting.length;
    this.waiting[this.steps % many].set(action);
    functions.move(this.f, this.waiting[(this.steps + 1) % many], this.k);
    if (this.f[rows.refused] > 0) {
      this.f.set(this.kept);
      this.over = "refused";
      return 0;
    }
    const reward = this.f[rows.reward];
    this.total += reward;
    const ended = this.f[rows.ended] > 0;
    this.steps += 1;
    if (about.draws) functions.kick(this.f, this.draws(about.draws, this.key, this.steps), this.k);
    this.observe();
    this.over = ended ? "terminated" : about.limit !== null && this.steps >= about.limit ? "truncated" : "";
    return reward;
  }

  part(name) {
    return this.f.subarray(...this.code.about.rows[name]);
  }

  /** Where the frames are, written into `room`. */
  poses(room = roomOf(this.code.about)) {
    const { functions } = this.code;
    functions.poses(this.f, this.p, this.k);
    for (let i = 0; i < this.p.length; i++) room[i >> 2][i & 3] = this.p[i];
    return room;
  }
}

/** The action for the numbers of a step. */
const actionOf = (key, { controls, levels, largest }) => key.map((n, i) => (controls[i].values.length ? n : largest * (n / levels)));

// --- links -----------------------------------------------------------------------------------------------
// The same as lag_envs/replay.py.

const MARK = "drive=";
const view = new DataView(new ArrayBuffer(8));

/** The 16 hexadecimal digits of a double. */
function hexOf(x) {
  view.setFloat64(0, x);
  return view.getBigUint64(0).toString(16).padStart(16, "0");
}

function doubleOf(hex) {
  view.setBigUint64(0, big(`0x${hex}`));
  return view.getFloat64(0);
}

/** All digits of a number, and the sign of a zero. */
const exact = (x) => (Object.is(x, -0) ? "−0" : String(x).replace(/-/g, "−"));

function crc32(text) {
  let crc = -1;
  for (const byte of new TextEncoder().encode(text)) {
    crc ^= byte;
    for (let i = 0; i < 8; i++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ((crc ^ -1) >>> 0).toString(16).padStart(8, "0");
}

function pack(keys) {
  const runs = [];
  for (const key of keys) {
    const last = runs[runs.length - 1];
    if (last && last.key.every((n, i) => n === key[i])) last.count += 1;
    else runs.push({ key, count: 1 });
  }
  let bytes = "";
  for (let m of runs.flatMap(({ key, count }) => [...key.map((n) => (n >= 0 ? 2 * n : -2 * n - 1)), count])) {
    for (; m >= 128; m = Math.floor(m / 128)) bytes += String.fromCharCode((m % 128) + 128);
    bytes += String.fromCharCode(m);
  }
  return btoa(bytes).replace(/\+/g, "-").replace(/\//g, "_").replace(/=+$/, "");
}

function unpack(text, { controls, levels }) {
  const bytes = atob(text.replace(/-/g, "+").replace(/_/g, "/"));
  const numbers = [];
  let [value, scale] = [0, 1];
  for (const letter of bytes) {
    const byte = letter.charCodeAt(0);
    value += (byte % 128) * scale;
    scale *= 128;
    if (scale > 2 ** 35) throw new Error("The link's keys are damaged: a number is too long.");
    if (byte < 128) {
      numbers.push(value);
      [value, scale] = [0, 1];
    }
  }
  const wide = controls.length + 1;
  if (scale > 1 || numbers.length % wide) throw new Error("The link's keys are damaged: they end in the middle of a key.");
  const keys = [];
  for (let i = 0; i < numbers.length; i += wide) {
    const key = numbers.slice(i, i + wide - 1).map((m) => (m % 2 ? -(m - 1) / 2 - 1 : m / 2));
    const count = numbers[i + wide - 1];
    if (!count || keys.length + count > 100000) throw new Error("The link has too many steps, or an empty run.");
    key.forEach((n, j) => {
      const many = controls[j].values.length;
      const [low, high] = many ? [0, many - 1] : [-levels, levels];
      if (n < low || n > high) throw new Error(`A key of the link is ${n}; it must lie between ${low} and ${high}.`);
    });
    for (let j = 0; j < count; j++) keys.push(key);
  }
  return keys;
}

function writeLink(about, seed, keys, total, page = "") {
  const fields = [about.version, about.id, String(seed), pack(keys), hexOf(total), about.digest].join("~");
  return `${page}#${MARK}${fields}~${crc32(fields)}`;
}

/** The contents of a link; throws an error with a text for the reader. */
function readLink(link, about) {
  const fields = link.slice(link.lastIndexOf(MARK) + MARK.length).trim().split("~");
  if (!link.includes(MARK) || fields.length < 2) throw new Error("This is not a link to a drive.");
  if (fields[0] !== String(about.version)) throw new Error("The link's version is not one that this page reads.");
  const [, id, seed, packed, claimed, digest, check] = fields;
  if (fields.length !== 7 || check !== crc32(fields.slice(0, 6).join("~"))) {
    throw new Error("The link is damaged; copy all of it again.");
  }
  if (id !== about.id) throw Object.assign(new Error(`The link belongs to another environment, ${id.slice(0, 60)}.`), { id });
  if (!/^(0|[1-9]\d{0,19})$/.test(seed) || big(seed) >> big(BITS) || !/^[0-9a-f]{16}$/.test(claimed) || !/^[\w-]*$/.test(packed) || packed.length % 4 === 1) {
    throw new Error("The link is forged: a field is not what it must be.");
  }
  if (!Number.isFinite(doubleOf(claimed))) throw new Error("The link is forged: the return that it claims is not a finite number.");
  if (digest !== about.digest) throw new Error("The drive was made with another version of this environment.");
  if (!packed) throw new Error("The link's drive has no steps.");
  return { seed: big(seed), keys: unpack(packed, about), claimed };
}

// --- agents ----------------------------------------------------------------------------------------------

/** Numbers of an array in base64. */
function numbersOf({ data, bits }) {
  const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
  return bits === 32 ? new Float32Array(bytes.buffer) : new Float64Array(bytes.buffer);
}

const sigmoid = (x) => 0.5 + 0.5 * Math.tanh(0.5 * x);
const ACTIVATIONS = {
  tanh: Math.tanh,
  relu: (x) => Math.max(x, 0),
  elu: (x) => (x > 0 ? x : Math.expm1(x)),
  leaky_relu: (x) => (x > 0 ? x : 0.01 * x),
  silu: (x) => x * sigmoid(x),
  sigmoid,
};

/** A function from an episode to its next action, like the architectures of lag_envs/leaderboard. */
function agentOf(about) {
  const arrays = Object.fromEntries(
    Object.entries(about.arrays).map(([name, array]) => [name, { n: numbersOf(array), shape: array.shape }]),
  );
  const kinds = { mlp, gru, linear: feedback, plan, "action table": table, "value table": table };
  const numbers = kinds[about.kind](about, arrays);
  let action = null;
  return (episode) => {
    action ??= new Float64Array(episode.code.about.rest.length);
    return actionsFrom(numbers(episode), about, action);
  };
}

/** Numbers as an action: clipped in a range; in a list, the largest number chooses. The array is reused. */
function actionsFrom(numbers, { choices, largest }, action) {
  if (!choices.length) {
    for (let i = 0; i < action.length; i++) action[i] = Math.fround(clamp(numbers[i], -largest, largest));
    return action;
  }
  for (let i = 0, end = 0; i < choices.length; i++) action[i] = largestOf(numbers, end, (end += choices[i]));
  return action;
}

/** The place of the largest number of a part, counted from its beginning. */
function largestOf(x, from = 0, to = x.length) {
  let best = from;
  for (let i = from + 1; i < to; i++) if (x[i] > x[best]) best = i;
  return best - from;
}

/** State and target that an agent reads from what it sees, as ObservationDecoder does. */
function reader({ zero, inverse, states, width, pairs }) {
  const wide = inverse[0].length;
  const lifted = new Float64Array(wide);
  const read = { state: new Float64Array(states), target: 0 };
  return ({ seen }) => {
    lifted.fill(0);
    for (let i = 0; i < seen.length; i++) {
      for (let j = 0; j < wide; j++) lifted[j] += (seen[i] - zero[i]) * inverse[i][j];
    }
    for (let i = 0; i < states; i++) read.state[i] = lifted[i];
    for (let n = 0; n < pairs.length; n++) read.state[pairs[n][0]] = Math.atan2(lifted[pairs[n][1] + 1], lifted[pairs[n][1]]);
    read.target = lifted[width];
    return read;
  };
}

/** A layer without its activation, in a separate array: column by column, because many inputs may be 0. */
function affine(weight, bias) {
  const [rows, wide] = weight.shape;
  const columns = new Float64Array(rows * wide);
  weight.n.forEach((x, at) => (columns[(at % wide) * rows + Math.floor(at / wide)] = x));
  const out = new Float64Array(rows);
  return (x) => {
    out.set(bias.n);
    for (let i = 0; i < wide; i++) {
      const factor = x[i];
      if (factor === 0) continue;
      for (let row = 0, at = i * rows; row < rows; row++, at++) out[row] += factor * columns[at];
    }
    return out;
  };
}

/** Change all numbers of an array. */
function apply(x, change) {
  for (let i = 0; i < x.length; i++) x[i] = change(x[i]);
  return x;
}

/** Observations as a network's input. */
function normaliser({ normalise }, { obs_mean: mean, obs_var: variance }) {
  if (!normalise) return (x) => x;
  const { epsilon, clip } = normalise;
  const out = new Float64Array(mean.n.length);
  return (x) => {
    for (let i = 0; i < out.length; i++) out[i] = clamp((x[i] - mean.n[i]) / Math.sqrt(variance.n[i] + epsilon), -clip, clip);
    return out;
  };
}

/** The output of a network's layers. */
function layers(about, arrays) {
  const { bins, choices, controls, largest, mean_limit: limit } = about;
  const activation = ACTIVATIONS[about.activation];
  const all = Array.from({ length: about.layers }, (_, k) => affine(arrays[`weight_${k}`], arrays[`bias_${k}`]));
  const out = new Float64Array(controls);
  const limited = (v) => clamp(v, -limit, limit);
  const squashed = (v) => largest * Math.tanh(v);
  return (x) => {
    for (let k = 0; k < all.length; k++) {
      x = all[k](x);
      if (k + 1 < all.length) apply(x, activation);
    }
    if (choices.length) return x;
    if (bins) {
      for (let i = 0; i < controls; i++) out[i] = largest * ((2 * largestOf(x, i * bins, (i + 1) * bins) + 1) / bins - 1);
      return out;
    }
    if (limit) apply(x, limited);
    return about.squash === "tanh" ? apply(x, squashed) : x;
  };
}

function mlp(about, arrays) {
  const [normalised, outputs] = [normaliser(about, arrays), layers(about, arrays)];
  let frames = null;
  return ({ seen, steps }) => {
    const wide = seen.length;
    frames ??= new Float64Array(about.frames * wide);
    if (!steps) {
      frames.fill(0);
      if (about.padding === "first") for (let at = 0; at < frames.length; at += wide) frames.set(seen, at);
    }
    frames.copyWithin(0, wide);
    frames.set(seen, frames.length - wide);
    return outputs(normalised(frames));
  };
}

function gru(about, arrays) {
  const [normalised, outputs] = [normaliser(about, arrays), layers(about, arrays)];
  const [input, hidden] = [affine(arrays.weight_ih, arrays.bias_ih), affine(arrays.weight_hh, arrays.bias_hh)];
  const size = about.memory;
  const memory = new Float64Array(size);
  return ({ seen, steps }) => {
    if (!steps) memory.fill(0);
    const [o, h] = [input(normalised(seen)), hidden(memory)];
    for (let i = 0; i < size; i++) {
      const r = sigmoid(o[i] + h[i]);
      const z = sigmoid(o[size + i] + h[size + i]);
      memory[i] = (1 - z) * Math.tanh(o[2 * size + i] + r * h[2 * size + i]) + z * memory[i];
    }
    return outputs(memory);
  };
}

function feedback(about, { gain, offset }) {
  const out = new Float64Array(offset.n.length);
  return ({ seen }) => {
    for (let j = 0; j < out.length; j++) {
      let sum = offset.n[j];
      for (let i = 0; i < seen.length; i++) sum += seen[i] * gain.n[i * out.length + j];
      out[j] = sum;
    }
    return out;
  };
}

/** x rounded to a whole number, halves to the even number. */
function rounded(x) {
  const found = Math.round(x);
  return found - x === 0.5 && found % 2 ? found - 1 : found;
}

/** Planned actions minus gains times the state's distance from the plan; after the plan's end, those of its last step. */
function plan(about, { states, actions, gains }) {
  const read = reader(about.read);
  const wrapped = about.read.pairs.map(([i]) => i);
  const [[length, wide], many] = [states.shape, actions.shape[1]];
  const [off, out] = [new Float64Array(wide), new Float64Array(many)];
  return (episode) => {
    const now = Math.min(episode.steps, length - 1);
    const { state } = read(episode);
    for (let i = 0; i < wide; i++) off[i] = state[i] - states.n[now * wide + i];
    for (const i of wrapped) off[i] -= 2 * Math.PI * rounded(off[i] / (2 * Math.PI));
    for (let j = 0; j < many; j++) {
      let sum = 0;
      for (let i = 0; i < wide; i++) sum += gains.n[(now * many + j) * wide + i] * off[i];
      out[j] = actions.n[now * many + j] - sum;
    }
    return out;
  };
}

function table(about, arrays) {
  const axes = about.axes.map((_, j) => arrays[`axis_${j}`].n);
  const values = arrays.table.n;
  const read = reader(about.read);
  const strides = axes.map((_, j) => axes.slice(j + 1).reduce((product, axis) => product * axis.length, 1));

  const [given, points] = [new Float64Array(about.sums[0].length), new Float64Array(axes.length)];
  const [cells, places] = [new Int32Array(axes.length), new Float64Array(axes.length)];
  let mirrored = false;

  /** The table's number at a moment; `mirrored` says whether it is from the mirror image. */
  function lookUp(state, target, steps) {
    given.set(state);
    given[state.length] = target;
    given[state.length + 1] = steps * about.interval;
    for (const [i] of about.read.pairs) given[i] -= 2 * Math.PI * Math.round(given[i] / (2 * Math.PI));
    for (let j = 0; j < axes.length; j++) {
      points[j] = 0;
      for (let i = 0; i < given.length; i++) if (about.sums[j][i]) points[j] += about.sums[j][i] * given[i];
    }
    mirrored = about.mirror !== null && points[about.mirror] < 0;
    for (let j = 0; j < axes.length; j++) {
      const [axis, at] = [axes[j], mirrored && about.axes[j] !== "time" ? -points[j] : points[j]];
      let cell = 0;
      for (let end = axis.length - 1; end - cell > 1;) {
        const middle = (cell + end) >> 1;
        if (axis[middle] <= at) cell = middle;
        else end = middle;
      }
      cells[j] = cell;
      places[j] = clamp((at - axis[cell]) / (axis[cell + 1] - axis[cell]), 0, 1);
    }
    let total = 0;
    for (let corner = 0; corner < 1 << axes.length; corner++) {
      let [weight, index] = [1, 0];
      for (let j = 0; j < axes.length; j++) {
        const upper = (corner >> j) & 1;
        weight *= upper ? places[j] : 1 - places[j];
        index += (cells[j] + upper) * strides[j];
      }
      if (weight) total += weight * values[index];
    }
    return total;
  }

  const out = [0];
  if (about.kind === "action table") {
    return (episode) => {
      const { state, target } = read(episode);
      const found = lookUp(state, target, episode.steps);
      out[0] = mirrored ? about.sign * found : found;
      return out;
    };
  }

  const tried = [0];
  let before = null;
  let after = null;

  /** The values of actions: the reward of a step from the observed state, plus the value where it ends. */
  function worth(episode, actions, found) {
    const { functions, about: code } = episode.code;
    const { state, target } = read(episode);
    before ??= new Float64Array(episode.f.length);
    after ??= new Float64Array(episode.f.length);
    before.set(episode.f);
    before.set(state);
    before.fill(target, code.rows.g[0], code.rows.g[1]);
    functions.lift(before, episode.k);
    for (let i = 0; i < actions.length; i++) {
      after.set(before);
      tried[0] = actions[i];
      functions.move(after, tried, episode.k);
      for (let j = 0; j < next.length; j++) next[j] = after[j];
      found[i] = after[code.rows.reward];
      if (!(after[code.rows.ended] > 0)) found[i] += lookUp(next, target, episode.steps + 1);
    }
    return found;
  }

  const { choices, largest } = about;
  const next = new Float64Array(about.read.states);
  const roomFor = (n) => [new Float64Array(n), new Float64Array(n)];
  if (choices.length) {
    const [actions, found] = roomFor(choices[0]);
    for (let i = 0; i < choices[0]; i++) actions[i] = i;
    return (episode) => worth(episode, actions, found);
  }
  const spaced = (n) => Array.from({ length: n }, (_, i) => -1 + (2 * i) / (n - 1));
  const coarse = spaced(about.actions).map((x) => largest * x);
  const fine = spaced(17).map((x) => ((2 * largest) / (about.actions - 1)) * x);
  const [near, values1, values2] = [new Float64Array(17), new Float64Array(coarse.length), new Float64Array(17)];
  return (episode) => {
    const middle = coarse[largestOf(worth(episode, coarse, values1))];
    for (let i = 0; i < 17; i++) near[i] = clamp(middle + fine[i], -largest, largest);
    out[0] = near[largestOf(worth(episode, near, values2))];
    return out;
  };
}
