"use strict";
/* Driving an environment in the page. Loaded on demand.
 *
 * The step comes as functions that Python printed (lag_envs/envs/scripted.py); no physics is written here.
 * Arrays are named as there: k constants, f one environment's row, a action, d draws in [0, 1), p poses.
 * Of the imperfections of sensors and actuators, scripts know drawn parameters, noise and delayed actions.
 *
 * In this order: random numbers, episodes, links, agents, the player's input, the stage.
 */
(() => {
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

  /** The word, with its upper bits also further down. */
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

  /** The action for a step's numbers. */
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
    if (!packed) throw new Error("The link's drive has no step.");
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

  /** Numbers as an action: clipped in a range; in a list, the largest number chooses. The array is used again. */
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

  /** A layer without its activation, into an array of its own. */
  function affine(weight, bias) {
    const [factors, starts] = [weight.n, bias.n];
    const out = new Float64Array(starts.length);
    return (x) => {
      for (let row = 0, at = 0; row < out.length; row++) {
        let sum = starts[row];
        for (let i = 0; i < x.length; i++) sum += x[i] * factors[at++];
        out[row] = sum;
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

  /** x rounded to a whole number, halves to the even one. */
  function rounded(x) {
    const found = Math.round(x);
    return found - x === 0.5 && found % 2 ? found - 1 : found;
  }

  /** Planned actions minus gains times the state's distance from the plan; after the end, the last ones. */
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

  // --- the player's input ----------------------------------------------------------------------------------

  const PAIRS = [["ArrowLeft", "ArrowRight"], ["ArrowDown", "ArrowUp"], ["a", "d"], ["s", "w"]];
  const NAMES = { ArrowLeft: "←", ArrowRight: "→", ArrowDown: "↓", ArrowUp: "↑" };
  const SPOKEN = { ArrowLeft: "left arrow", ArrowRight: "right arrow", ArrowDown: "down arrow", ArrowUp: "up arrow" };
  const nameOf = (key) => NAMES[key] ?? key.toUpperCase();

  /** Keys, pointer and gamepad as numbers per control. */
  class Hands {
    constructor(about, lost) {
      [this.about, this.lost] = [about, lost];
      this.pressed = new Set();
      [this.pointer, this.finger] = [null, null];
      this.pad = null;
      this.held = {};
    }

    get pairs() {
      return PAIRS.slice(0, this.about.controls.length);
    }

    release() {
      this.pressed.clear();
      [this.pointer, this.finger] = [null, null];
    }

    /** The gamepad; null without one. */
    gamepad() {
      if (this.pad === null) return null;
      const pad = navigator.getGamepads?.()[this.pad];
      if (pad?.connected) return pad;
      this.pad = null;
      this.lost();
      return null;
    }

    /** What has just been pressed on the gamepad: A or Start, B, or the stick after it was at rest. */
    pressedOnPad() {
      const pad = this.gamepad();
      if (!pad) return {};
      const held = (i) => Boolean(pad.buttons[i]?.pressed);
      const before = this.held;
      this.held = { go: held(0) || held(9), again: held(1), stick: this.readPad() !== null };
      return Object.fromEntries(Object.entries(this.held).map(([name, now]) => [name, now && before[name] === false]));
    }

    /** The gamepad's input, [-1, 1] per axis; null without one, or if it is not touched. */
    readPad() {
      const pad = this.gamepad();
      if (!pad) return null;
      const button = (i) => (pad.buttons[i]?.pressed ? 1 : 0);
      const axes = [0, 1, 2, 3].map((i) => (Math.abs(pad.axes[i] ?? 0) > 0.12 ? pad.axes[i] : 0) * (i % 2 ? -1 : 1));
      axes[0] += button(15) - button(14);
      axes[1] += button(12) - button(13);
      return axes.some(Boolean) ? axes.map((x) => clamp(x, -1, 1)) : null;
    }

    /** A number for each control. Keys take precedence over the pointer, and the pointer over the gamepad. */
    numbers() {
      const pad = this.readPad();
      const { controls, levels, largest, rest } = this.about;
      return controls.map(({ values }, i) => {
        const many = values.length;
        const [down, up] = (PAIRS[i] ?? []).map((key) => this.pressed.has(key));
        const digit = many ? values.findIndex((_, j) => this.pressed.has(String(j + 1))) : -1;
        if (digit >= 0) return digit;
        let share = null;
        if (down || up) share = up - down;
        else if (this.pointer && i < 2) share = this.pointer[i];
        else if (pad) share = pad[i] ?? null;
        if (share === null || (share === 0 && many)) return many ? rest[i] : Math.round((rest[i] / largest) * levels);
        return many ? Math.round((0.5 + 0.5 * share) * (many - 1)) : Math.round(share * levels);
      });
    }
  }

  // --- the stage -------------------------------------------------------------------------------------------

  /** Steps after which a browser has compiled a scene's code. */
  const WARM = 300;
  /** The farthest that a finger moves in a tap [px]. */
  const TAP = 10;
  const idly = globalThis.requestIdleCallback?.bind(globalThis) ?? ((work) => setTimeout(work, 20));

  const LACKING = [
    ["64-bit integers (BigInt)", typeof BigInt === "function"],
    ["drawing (canvas)", typeof CanvasRenderingContext2D === "function"],
    ["animation (requestAnimationFrame)", typeof requestAnimationFrame === "function"],
  ];
  const lacking = () => LACKING.filter(([, there]) => !there).map(([what]) => what);

  /** A value with its numbers changed by those of others of the same shape: a + Σ (b - a). */
  function changed(base, others) {
    if (typeof base === "number") return others.reduce((sum, other) => sum + other - base, base);
    if (!Array.isArray(base)) return base;
    if (others.some((other) => other.length !== base.length)) return others[others.length - 1];
    return base.map((part, i) => changed(part, others.map((other) => other[i])));
  }

  /** Numbers of the same shape on the way from one to the other. */
  function scaled(a, b, share) {
    if (typeof a === "number") return a + (b - a) * share;
    if (!Array.isArray(a)) return a;
    return a.length === b.length ? a.map((part, i) => scaled(part, b[i], share)) : share < 0.5 ? a : b;
  }

  /** Build the driver into an element and return it. */
  function open(root, board, code, tools) {
    const { make, all, text, symbol, writeList, cleared, paint, placed, apart, windowOf, posesAt, load, calm } = tools;
    const { about } = code;
    const known = board.known && board.known.best !== board.known.random ? board.known : null;
    const scoreOf = (total) => (total - known.random) / (known.best - known.random);

    const option = (value, words) => make("option", { value }, words);
    const button = (name, words) => make("button", { type: "button", class: name }, words);
    const list = (label, options) => {
      const select = make("select", {}, ...options);
      return [make("label", {}, make("span", { class: "hear" }, label), select), select];
    };

    const canvas = make("canvas", { class: "scene", "aria-hidden": "true" });
    const message = make("p", { class: "message" });
    const stage = make("div", { class: "stage", tabindex: "0", role: "application" }, canvas, message);
    const readout = make("dl", { class: "readout" });
    const said = make("p", { class: "hear", role: "status" });
    const go = button("go", "Start");
    const again = button("again", "Restart");
    const fresh = button("fresh", "New start");
    const watch = button("rerun", "Watch it");
    const [speedLabel, speed] = list("Speed", [["1", "Real time"], ["0.5", "Half speed"], ["0.25", "Quarter speed"], ["0.1", "A tenth"]].map(([v, w]) => option(v, w)));
    const [ghostLabel, ghostSelect] = list("Ghost", [option("", "No ghost")]);
    const [episodeLabel, episodeSelect] = list("The ghost's episode", []);
    const bar = make("div", { class: "drive-controls", role: "group", "aria-label": "Driving" }, go, again, fresh, watch, speedLabel, ghostLabel, episodeLabel);
    const verdict = make("p", { class: "verdict", role: "status" });
    const link = make("input", { type: "text", readonly: "", "aria-label": "Link of this drive", placeholder: "Your drive's link, once it stops" });
    const copy = button("copy", "Copy link");
    const share = make("div", { class: "share" }, link, copy);
    const panel = make("details", { class: "sliders" }, make("summary", {}, "Change the machine (not scored)"));
    root.replaceChildren(verdict, stage, bar, readout, share, panel, said);
    copy.disabled = watch.hidden = episodeLabel.hidden = true;

    const hands = new Hands(about, () => {
      if (running) pause();
      tell("The gamepad is disconnected. Drive with the keys, or connect it again; Space continues.");
    });
    const lists = about.controls.map(({ values }) => values.length).filter(Boolean);
    const meant = lists.length > 1 ? "the action with that number in each list" : "one of the listed actions";
    const listed = lists.length ? `, or 1 to ${Math.min(Math.max(...lists), 9)} for ${meant}` : "";
    /** The keys and what they control, to be read or to be heard. */
    const described = (keys, name, unitOf) => hands.pairs
      .map((pair, i) => {
        const { meaning, unit } = about.controls[i];
        return `${keys(pair)} ${[meaning, name(about.controls[i])].filter(Boolean).join(" ")}${unit && unitOf(unit)}`;
      })
      .join(", ") + listed;
    const words = ({ name }) => name.replace(/_/g, " ");
    const letter = (control) => (control.meaning && symbol(control.name) === words(control) ? "" : symbol(control.name));
    const how = described((pair) => pair.map(nameOf).join(" "), letter, (unit) => ` [${unit}]`);
    const heard = described(
      (pair) => `${pair.map((key) => SPOKEN[key] ?? nameOf(key)).join(" and ")}:`,
      (control) => (control.meaning ? "" : words(control)),
      (unit) => ` in ${unit}`,
    );
    // Without a key the first of listed actions acts, which may push too.
    const unasked = about.controls
      .map(({ name, unit, values }, i) => (values[about.rest[i]] ? ` Without a key, ${symbol(name)} is ${text(values[about.rest[i]])} ${unit}.` : ""))
      .join("");
    const nothing = board.picture && about.frames ? "" : " This scene has nothing to draw; the numbers show how it moves.";
    const touched = matchMedia("(hover: none)").matches;
    const starting = (keys) => {
      const by = touched ? "A tap starts. Then hold a finger on the picture: the farther from the middle, the stronger."
        : `${keys}; or use the pointer or a gamepad. Space or a tap starts.`;
      return `${keys ? by : "There is nothing to control here: just watch. Space or a tap starts."}${unasked}${nothing}`;
    };
    stage.setAttribute("aria-label", `Drive ${board.id}. ${heard || "Nothing acts here"}. Space starts and pauses, R restarts, N is another start.`);

    let { constants } = code;
    let seed = big(Math.floor(Math.random() * 2 ** 32));
    let me = new Episode(code, seed, constants);
    let mine = [];
    let ghost = null;
    let linked = null;
    let rerunning = null;
    let running = false;
    let tapped = null;
    let [before, left, shownAt] = [0, 0, 0];
    let [past, now] = [me.poses(), me.poses()];
    const [between, ghostly] = [roomOf(about), roomOf(about)];
    let picture = board.picture;
    const untouched = () => constants === code.constants;
    const finished = (episode) => episode.over === "terminated" || episode.over === "truncated";
    const ended = () => Boolean(me.over || (rerunning && !rerunning.keys[me.steps]));

    /** A return, and its score if the episode is whole: where rewards are costs, a part of it looks too good. */
    const resultOf = (episode) => `return ${text(episode.total, 2)}${known && finished(episode) ? `, score ${text(scoreOf(episode.total))}` : ""}`;

    const tell = (words, spoken = words) => {
      message.textContent = words;
      said.textContent = spoken;
    };

    // --- ghosts

    /** The ghost: an agent, stored episodes, or the keys of a link. */
    const GHOSTS = {
      live: (row) => load(board.rows[row].live).then((data) => ({ name: board.rows[row].name, act: agentOf(data) })),
      stored: (row) => tools.episodes(board.rows[row].file).then((replays) => ({ name: board.rows[row].name, replays })),
      link: () => {
        const { seed: start, keys } = linked; // another link may come while this one's ghost runs
        const act = (episode) => actionOf(keys[episode.steps] ?? keys[keys.length - 1], about);
        return Promise.resolve({ name: "the link's driver", seed: start, steps: keys.length, act });
      },
    };

    function listGhosts() {
      const rows = [...board.rows.entries()];
      const group = (label, options) => (options.length ? [make("optgroup", { label }, ...options)] : []);
      const chosen = ghostSelect.value;
      ghostSelect.replaceChildren(
        option("", "No ghost"),
        ...(linked ? [option("link:0", "The link's drive")] : []),
        ...group("Agents, live", rows.filter(([, row]) => row.live).map(([i, row]) => option(`live:${i}`, String(row.name)))),
        ...group("Recorded episodes", rows.filter(([, row]) => row.file).map(([i, row]) => option(`stored:${i}`, String(row.name)))),
      );
      ghostSelect.value = chosen;
    }

    /** What a stored episode is, with the seed of its start if that is known. */
    function seeded({ label: name = "episode", return: total, reset_seed: start }) {
      return `${name}${start === undefined ? "" : `, seed ${start}`}, return ${text(total, 2)}`;
    }

    async function chooseGhost() {
      const [kind, row] = ghostSelect.value.split(":");
      const asked = ghostSelect.value;
      episodeLabel.hidden = true;
      ghost = null;
      if (kind) {
        let found;
        try {
          found = await GHOSTS[kind](Number(row));
        } catch (error) {
          tell(String(error.message));
          return;
        }
        if (ghostSelect.value !== asked) return;
        ghost = found;
        if (ghost.replays) {
          episodeSelect.replaceChildren(...ghost.replays.map((replay, i) => option(String(i), seeded(replay))));
          episodeLabel.hidden = false;
          chooseEpisode();
          return;
        }
        if (ghost.seed !== undefined) seed = ghost.seed;
      }
      restart();
      tell(starting(how), starting(heard));
      if (ghost?.act) warmUp();
    }

    function chooseEpisode() {
      ghost.replay = ghost.replays[Number(episodeSelect.value)] ?? ghost.replays[0];
      const start = ghost.replay.reset_seed;
      if (start !== undefined) seed = big(start);
      restart();
      tell(start === undefined ? "The seed of this episode is not known: the ghost starts elsewhere." : starting(how), starting(heard));
    }

    function startGhost() {
      if (!ghost?.act) return;
      ghost.episode = new Episode(code, seed, constants);
      [ghost.past, ghost.now] = [ghost.episode.poses(), ghost.episode.poses()];
    }

    function dismissGhost() {
      ghost = null;
      ghostSelect.value = "";
      episodeLabel.hidden = true;
    }

    function stepGhost() {
      if (!ghost?.act || ghost.episode.over || ghost.episode.steps >= ghost.steps) return;
      ghost.episode.step(ghost.act(ghost.episode));
      [ghost.past, ghost.now] = [ghost.now, ghost.episode.poses(ghost.past)];
    }

    /** The ghost's poses and return within the current step. */
    function ghostAt(part) {
      if (!ghost) return null;
      if (ghost.act) return { poses: mixedPoses(ghost.past, ghost.now, ghost.episode.over ? 1 : part, ghostly), total: ghost.episode.total };
      const { replay } = ghost;
      if (!replay?.poses) return null;
      const exact = clamp(me.steps - 1 + part, 0, replay.end);
      const moment = Math.floor(exact);
      return { poses: posesAt(replay.poses, board.picture.units, moment, exact - moment), total: replay.sums[moment] };
    }

    // --- time

    /** Poses between two moments, written into `room`; a control stays the same during a step. */
    function mixedPoses(a, b, part, room) {
      for (let i = 0; i < room.length; i++) {
        for (let j = 0; j < 3; j++) room[i][j] = a[i][j] + (b[i][j] - a[i][j]) * part;
        room[i][3] = b[i][3];
      }
      return room;
    }

    /** Keep the seed in the address, unless a link there already has it. */
    function note() {
      if (seed !== linked?.seed) history.replaceState(null, "", `#seed=${seed}`);
    }

    function restart() {
      me = new Episode(code, seed, constants);
      mine = [];
      [past, now] = [me.poses(), me.poses()];
      left = 0;
      setLink("");
      startGhost();
      if (running) note();
      label();
      show(1);
    }

    /**
     * Play on a trial episode in the browser's idle time. A browser runs new code slowly at first, up to a hundred
     * times, and compiles what it has often run; so a drive begins at full speed.
     */
    function warmUp() {
      const [trial, act, room] = [new Episode(code, seed, constants), ghost?.act ?? (() => about.rest), roomOf(about)];
      let steps = 0;
      const more = () => {
        if (running || me.steps) return; // an agent may have a memory that reaches back to the start of its episode
        const end = performance.now() + 2;
        do {
          if (trial.over) trial.restart(big(steps));
          trial.step(act(trial));
          trial.poses(room);
          steps += 1;
        } while (performance.now() < end);
        if (steps < WARM) idly(more);
      };
      idly(more);
    }

    function tick() {
      const key = rerunning ? rerunning.keys[me.steps] : hands.numbers();
      if (!key) {
        close("The link's keys end here");
        return;
      }
      me.step(actionOf(key, about));
      if (me.over !== "refused") mine.push(key);
      [past, now] = [now, me.poses(past)];
      stepGhost();
      if (me.over) close();
    }

    /** Stop. What is said and offered at the end waits for the next frames: it lays out the page anew. */
    function close(words = "") {
      const of = me;
      const later = (work) => () => {
        if (me === of && !running) work();
      };
      running = false;
      requestAnimationFrame(later(() => {
        finish(words);
        idly(later(offer));
      }));
    }

    function finish(words) {
      label();
      const ending = words || { terminated: "The episode has ended", truncated: "Time is up", refused: "The next step was refused, because it cannot be computed to full accuracy" }[me.over];
      const result = untouched() ? resultOf(me) : `return ${text(me.total, 2)}, not scored`;
      const beside = ghost && ghostAt(1) ? `; ${ghost.name}: return ${text(ghostAt(1).total, 2)} by then` : "";
      tell(`${ending}: ${result}${beside}. R: ${rerunning ? "drive from this start" : "again"}, N: another start.`);
    }

    function setLink(value) {
      link.value = value;
      copy.disabled = !value;
    }

    /** Offer the link of this drive. */
    function offer() {
      if (!untouched() || !mine.length || rerunning) return;
      setLink(writeLink(about, seed, mine, me.total, location.href.replace(/#.*/, "")));
    }

    function frame(time) {
      if (!running) return;
      left += Math.min(Math.max(time - before, 0), 100) / 1000 * Number(speed.value);
      before = time;
      // Where the steps of a frame take too long, time runs slower instead of in jerks.
      const end = performance.now() + 3;
      while (running && left >= about.dt) {
        left -= about.dt;
        tick();
        if (performance.now() > end) break;
      }
      if (left > about.dt) left = about.dt;
      show(running ? left / about.dt : 1);
      if (running) requestAnimationFrame(frame);
    }

    function label() {
      stage.toggleAttribute("data-driving", running);
      go.textContent = running ? "Pause" : ended() ? "Start again" : me.steps ? "Resume" : "Start";
    }

    function run() {
      if (running) return;
      running = true;
      tapped = null;
      note();
      message.textContent = rerunning ? "Watching the link's drive: you do not steer. Space pauses, R lets you drive." : "";
      said.textContent = message.textContent || "Driving";
      setLink("");
      before = performance.now();
      label();
      requestAnimationFrame(frame);
    }

    /** Pause or go on. What has ended starts again, with the player at the controls. */
    function toggle() {
      if (running) {
        pause();
        return;
      }
      if (ended()) {
        rerunning = null;
        restart();
      }
      run();
    }

    function pause() {
      running = false;
      hands.release();
      label();
      tell(`Paused at ${text(me.steps * about.dt, 2)} seconds.`);
      offer();
      show(1);
    }

    // --- what is to be seen

    function show(part) {
      const { pen, width, height } = cleared(canvas);
      if (width && picture && about.frames) {
        const box = { x: 8, y: 8, width: width - 16, height: height - 16 };
        const poses = mixedPoses(past, now, part, between);
        const seenFrom = windowOf(picture, poses);
        paint(pen, box, seenFrom, placed(picture, poses, seenFrom));
        const beside = ghostAt(part);
        if (beside) {
          pen.globalAlpha = 0.35;
          paint(pen, box, seenFrom, placed(apart(picture, beside.poses, poses), beside.poses, seenFrom));
          pen.globalAlpha = 1;
        }
      }
      // Numbers that change sixty times a second cannot be read, and cost more than the step.
      const moment = performance.now();
      if (running && moment - shownAt < 120) return;
      shownAt = moment;
      readOut(ghostAt(part));
    }

    /** The control that a step's number asks for, within the limit that a slider may have changed. */
    function controlOf(n, { values, low, high }) {
      if (values.length) return values[n];
      const limit = about.sliders.find(({ shown }) => shown);
      const share = (n / about.levels) * (limit ? constants[limit.at] : 1);
      return low === -high ? high * share : low + (high - low) * (0.5 + 0.5 * share);
    }

    function readOut(beside) {
      const score = known && (finished(me) ? text(scoreOf(me.total)) : !ended() && "at the end") || "–";
      const keys = rerunning ? rerunning.keys[Math.max(0, me.steps - 1)] ?? [] : mine[mine.length - 1] ?? [];
      writeList(readout, [
        ["Time", `${text(me.steps * about.dt, 2)} s`],
        ["Return", text(me.total, 2)],
        ...(ghost ? [["Ghost's return", beside ? text(beside.total, 2) : "–"]] : []),
        ["Score", untouched() ? score : "not scored"],
        ...about.controls.map((control, i) => {
          const { name, unit, low, high } = control;
          const digits = Math.max(-low, high) < 1 ? 3 : 2;
          return [symbol(name), keys[i] === undefined ? "–" : `${text(controlOf(keys[i], control), digits)} ${unit}`.trim()];
        }),
        ...board.state_names.map((name, i) => [symbol(name), `${text(me.f[i], 2)} ${board.state_units[i] ?? ""}`]),
      ]);
    }

    // --- sliders

    function look() {
      if (!board.picture) return null;
      const others = about.sliders.filter((slider) => slider.looks).map(({ looks, at }) => {
        const place = clamp(2 * Math.log2(constants[at] / code.constants[at]) + 2, 0, looks.length - 1);
        const first = Math.min(Math.floor(place), looks.length - 2);
        return scaled([looks[first].shapes, looks[first].window], [looks[first + 1].shapes, looks[first + 1].window], place - first);
      });
      const { shapes, window: box } = board.picture;
      const [all, wide] = others.length && !untouched() ? changed([shapes, box], others) : [shapes, box];
      return { ...board.picture, shapes: all, window: wide };
    }

    const inputs = about.sliders.map((slider) => {
      const input = make("input", { type: "range", min: "-1", max: "1", step: "0.01", value: "0" });
      const output = make("output");
      const name = slider.name.replace(/^com_/, "centre-of-mass ").replace(/_/g, " ");
      const say = () => {
        const value = slider.value * 2 ** Number(input.value);
        output.textContent = `${+(value * (slider.shown ?? 1)).toPrecision(3)} ${slider.unit}`;
        input.setAttribute("aria-valuetext", output.textContent);
        return value;
      };
      say();
      input.addEventListener("input", () => {
        rerunning = null;
        change();
      });
      panel.append(make("label", {}, make("span", {}, name), input, output));
      return { slider, input, say };
    });

    /** Apply the sliders' values and all that follows from them, and start over. */
    function change() {
      const values = inputs.map(({ say }) => say());
      constants = code.constants;
      if (inputs.some(({ input }) => Number(input.value) !== 0)) {
        constants = Float64Array.from(code.constants);
        inputs.forEach(({ slider }, i) => (constants[slider.at] = values[i]));
        code.functions.derive(constants);
      }
      picture = look();
      restart();
      tell(untouched() ? "The machine is as it was: drives are scored again." : "The machine was changed: this drive is not scored.");
    }
    const reset = button("reset", "Reset");
    reset.addEventListener("click", () => {
      for (const { input } of inputs) input.value = "0";
      change();
    });
    panel.append(reset);
    panel.hidden = !inputs.length;

    // --- links

    /** Recompute a link's drive, a little in each frame, and tell whether its claim is true. */
    function checkLink(hash) {
      linked = rerunning = null;
      watch.hidden = true;
      if (ghostSelect.value.startsWith("link:")) dismissGhost();
      listGhosts();
      let told;
      try {
        told = readLink(hash, about);
      } catch (error) {
        verdict.textContent = String(error.message);
        verdict.dataset.true = "false";
        // Only the page's own links are offered, as the link may hold anything.
        const page = error.id && all(".top nav a").find((one) => one.textContent === error.id);
        if (page) verdict.append(" ", make("a", { href: page.getAttribute("href") + location.hash }, "Open it there"), ".");
        return;
      }
      const episode = new Episode(code, told.seed);
      verdict.textContent = "The link is being recomputed …";
      delete verdict.dataset.true;
      const go = () => {
        const until = performance.now() + 4;
        const more = () => episode.steps < told.keys.length && !episode.over;
        while (more() && performance.now() < until) episode.step(actionOf(told.keys[episode.steps], about));
        if (more()) {
          requestAnimationFrame(go);
          return;
        }
        const fair = hexOf(episode.total) === told.claimed;
        const forged = episode.over === "refused" ? `step ${episode.steps + 1} cannot be taken`
          : episode.steps < told.keys.length ? `its episode ends after ${episode.steps} steps, but it has keys for ${told.keys.length}` : "";
        verdict.dataset.true = String(fair && !forged);
        if (forged) {
          verdict.textContent = `The link is forged: ${forged}.`;
          return;
        }
        verdict.textContent = fair
          ? `The link is true, recomputed to the last bit: ${resultOf(episode)}${episode.over ? "" : "; it stops before the episode's end, so it has no score"}.`
          : `The link is false: it claims a return of ${exact(doubleOf(told.claimed))}, but its keys give ${exact(episode.total)}.`;
        if (!untouched()) reset.click();
        linked = told;
        seed = told.seed;
        watch.hidden = false;
        listGhosts();
        if (fair) {
          ghostSelect.value = "link:0";
          chooseGhost();
        } else {
          restart();
        }
      };
      go();
    }

    function followHash() {
      let { hash } = location;
      try {
        hash = decodeURIComponent(hash);
      } catch {
        // Left as it is, it will be refused.
      }
      verdict.textContent = "";
      if (hash.includes(MARK)) {
        stage.focus();
        checkLink(hash);
        return;
      }
      const match = /^#seed=(\d{1,20})$/.exec(hash);
      if (!match) return;
      if (big(match[1]) >> big(BITS)) {
        verdict.textContent = "The seed must be below 2 to the power of 64.";
        verdict.dataset.true = "false";
        return;
      }
      stage.focus();
      seed = big(match[1]);
      running = false;
      rerunning = null;
      restart();
      tell(starting(how), starting(heard));
    }

    // --- what people do

    const still = (event) => event.ctrlKey || event.altKey || event.metaKey;

    const acts = { " ": toggle, r: afresh, n: another };
    stage.addEventListener("keydown", (event) => {
      if (still(event) || event.target !== stage) return;
      const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
      const drives = hands.pairs.flat().includes(key) || (/^[1-9]$/.test(key) && about.controls.some((c) => c.values.length));
      if (drives) {
        hands.pressed.add(key);
        if (!running && !ended()) run();
      } else if (key in acts) {
        if (!event.repeat) acts[key]();
      } else return;
      event.preventDefault();
    });
    stage.addEventListener("keyup", (event) => hands.pressed.delete(event.key.length === 1 ? event.key.toLowerCase() : event.key));
    stage.addEventListener("blur", () => hands.release());

    function afresh() {
      rerunning = null;
      restart();
      run();
    }

    function another() {
      if (ghost?.replays || ghost?.seed !== undefined) dismissGhost();
      seed = big(Math.floor(Math.random() * 2 ** 32));
      afresh();
    }

    function point(event) {
      const box = canvas.getBoundingClientRect();
      const across = (event.clientX - box.left - box.width / 2) / (0.42 * box.width);
      const up = (box.top + box.height / 2 - event.clientY) / (0.42 * box.height);
      hands.pointer = [clamp(across, -1, 1), clamp(up, -1, 1)];
    }

    // A finger at rest on the picture scrolls the page, unless it taps; while one drives, it steers.
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button || hands.finger !== null) return;
      if (!running && event.pointerType === "touch") {
        tapped = event;
        return;
      }
      canvas.setPointerCapture?.(event.pointerId);
      stage.focus({ preventScroll: true });
      if (!running) toggle();
      hands.finger = event.pointerId;
      point(event);
      event.preventDefault();
    });
    canvas.addEventListener("pointermove", (event) => event.pointerId === hands.finger && point(event));
    canvas.addEventListener("pointerup", (event) => {
      const same = tapped?.pointerId === event.pointerId;
      if (!same || Math.hypot(event.clientX - tapped.clientX, event.clientY - tapped.clientY) > TAP) return;
      stage.focus({ preventScroll: true });
      toggle();
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(name, (event) => {
        if (event.pointerId === hands.finger) [hands.pointer, hands.finger] = [null, null];
        if (event.pointerId === tapped?.pointerId) tapped = null;
      });
    }

    /** Follow the gamepad's buttons while there is one. */
    function poll() {
      const pressed = hands.pressedOnPad();
      if (pressed.go) toggle();
      else if (pressed.again) afresh();
      else if (pressed.stick && !running && !ended()) run();
      if (running && (pressed.go || pressed.again || pressed.stick)) stage.focus();
      if (hands.pad !== null) requestAnimationFrame(poll);
    }
    const take = (pad) => {
      if (hands.pad === null) requestAnimationFrame(poll);
      [hands.pad, hands.held] = [pad.index, {}];
      tell("A gamepad is connected: drive with its stick. A or Start starts and pauses, B restarts.");
    };
    window.addEventListener("gamepadconnected", (event) => take(event.gamepad));
    window.addEventListener("gamepaddisconnected", () => hands.gamepad());
    document.addEventListener("visibilitychange", () => document.hidden && running && pause());

    for (const [pressed, act] of [[go, toggle], [again, afresh], [fresh, another]]) {
      pressed.addEventListener("click", () => {
        act();
        if (running) stage.focus({ preventScroll: true });
      });
    }
    watch.addEventListener("click", () => {
      running = false;
      dismissGhost();
      reset.click();
      seed = linked.seed;
      rerunning = linked;
      restart();
      run();
      stage.focus({ preventScroll: true });
    });
    speed.addEventListener("change", () => (before = performance.now()));
    ghostSelect.addEventListener("change", () => {
      running = false;
      rerunning = null;
      chooseGhost();
    });
    episodeSelect.addEventListener("change", () => {
      running = false;
      chooseEpisode();
    });
    link.addEventListener("focus", () => link.select());
    copy.addEventListener("click", async () => {
      link.select();
      try {
        await navigator.clipboard.writeText(link.value);
        said.textContent = "The link was copied.";
      } catch {
        // Pages opened from disk may not use the clipboard; the selected link can be copied by hand.
        tell("Copy the selected link.");
      }
    });
    window.addEventListener("hashchange", followHash);

    listGhosts();
    restart();
    warmUp();
    tell(starting(how), starting(heard));
    if (calm.matches) speed.value = "0.5";
    const there = [...(navigator.getGamepads?.() ?? [])].find((pad) => pad?.connected);
    if (there) take(there);
    followHash();
    return { show: () => show(1), get episode() { return me; } };
  }

  window.lagEnvs.put({ Episode, agentOf, hexOf, lacking, open });
})();
