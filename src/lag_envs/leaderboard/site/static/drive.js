"use strict";
/* Driving an environment in the page. Loaded on demand.
 *
 * The step comes as functions that Python printed (lag_envs/envs/unfused.py); no physics is written here.
 * Arrays are named as there: k constants, f one environment's row, a action, d draws in [0, 1), p poses.
 * Of the imperfections of sensors and actuators, scripts know drawn parameters, noise and delayed actions.
 *
 * In this order: random numbers, episodes, links, agents, the player's input, the stage.
 */
(() => {
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

  // --- random numbers --------------------------------------------------------------------------------------
  // The same as lag_envs/stepping/primitives.py: SplitMix64's mix of key, step and index, in 64 bits.

  const big = (x) => BigInt(x);
  const BITS = 64;
  const word = (x) => BigInt.asUintN(BITS, x);
  const [GOLDEN, FIRST, SECOND] = ["0x9E3779B97F4A7C15", "0xBF58476D1CE4E5B9", "0x94D049BB133111EB"].map(big);
  const PER_STEP = 16;
  const [S30, S27, S31, S11, DRAWS, ONE] = [30, 27, 31, 11, PER_STEP, 1].map(big);
  /** Keys of draws that are not the episode's own, as lag_envs/envs/imperfect/draws.py has them. */
  const PURPOSES = { parameters: big(1), observation: big(2) };

  function mixed(z) {
    z = word((z ^ (z >> S30)) * FIRST);
    z = word((z ^ (z >> S27)) * SECOND);
    return z ^ (z >> S31);
  }

  const episodeKey = (key, episode) => mixed(word(mixed(key) + episode * GOLDEN));

  /** Draw `index` of step `step`, in [0, 1). */
  function uniform(key, step, index) {
    return Number(mixed(word(key + (big(step) * DRAWS + big(index) + ONE) * GOLDEN)) >> S11) * 2 ** -53;
  }

  // --- episodes --------------------------------------------------------------------------------------------

  /** An environment, stepped by the printed functions. */
  class Episode {
    constructor(code, seed, constants = code.constants) {
      const { about } = code;
      this.code = code;
      this.k = Float64Array.from(constants);
      this.f = new Float64Array(about.size);
      this.kept = new Float64Array(about.size);
      this.restart(seed);
    }

    restart(seed) {
      const { functions, about } = this.code;
      this.key = episodeKey(big(seed), ONE);
      [this.steps, this.total, this.over] = [0, 0, ""];
      this.waiting = Array(about.delay).fill(about.rest);
      if (about.drawn) {
        functions.draw(this.k, this.draws(about.drawn, "parameters"));
        functions.derive(this.k);
      }
      functions.start(this.f, this.draws(about.starts), this.k);
      this.observe();
    }

    /** Draws of this step, from the episode's own key or that of a purpose. */
    draws(count, purpose) {
      const key = purpose ? episodeKey(this.key, PURPOSES[purpose]) : this.key;
      const step = purpose ? this.steps * Math.ceil(count / PER_STEP) : this.steps;
      return Float64Array.from({ length: count }, (_, i) => uniform(key, step, i));
    }

    observe() {
      const { functions, about } = this.code;
      functions.observe(this.f, this.k);
      functions.sense?.(this.f, this.draws(about.noise, "observation"), this.k);
    }

    /** Hold an action for one interval; returns the reward. Afterwards `over` says how it ended, if it did. */
    step(action) {
      const { functions, about } = this.code;
      const { rows } = about;
      this.kept.set(this.f);
      this.waiting.push(action);
      functions.move(this.f, this.waiting.shift(), this.k);
      if (this.f[rows.refused] > 0) {
        this.f.set(this.kept);
        this.over = "refused";
        return 0;
      }
      this.steps += 1;
      const reward = this.f[rows.reward];
      this.total += reward;
      const ended = this.f[rows.ended] > 0;
      if (about.draws) functions.kick(this.f, this.draws(about.draws), this.k);
      this.observe();
      this.over = ended ? "terminated" : about.limit !== null && this.steps >= about.limit ? "truncated" : "";
      return reward;
    }

    part(name) {
      return this.f.subarray(...this.code.about.rows[name]);
    }

    get state() {
      return this.f.subarray(0, this.code.about.states);
    }

    /** Where the frames are, [x, y, angle, part] each. */
    poses() {
      const { functions, about } = this.code;
      const p = new Float64Array(4 * about.frames);
      functions.poses(this.f, p, this.k);
      return Array.from({ length: about.frames }, (_, i) => [...p.subarray(4 * i, 4 * i + 4)]);
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
    if (id !== about.id) throw new Error(`The link belongs to another environment, ${id.slice(0, 60)}.`);
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
    return (episode) => actionsFrom(numbers(episode), about);
  }

  /** Numbers as an action: clipped in a range; in a list, the largest number chooses. */
  function actionsFrom(numbers, { choices, largest }) {
    if (!choices.length) return Array.from(numbers, (x) => Math.fround(clamp(x, -largest, largest)));
    let end = 0;
    return choices.map((count) => indexOfLargest(numbers.slice(end, (end += count))));
  }

  const indexOfLargest = (x) => x.reduce((best, v, i) => (v > x[best] ? i : best), 0);

  /** What an agent sees, in float32. */
  const seen = (episode) => Float64Array.from(episode.part("o"), Math.fround);

  /** State and target that an agent reads from what it sees, as ObservationDecoder does. */
  function reader({ zero, inverse, states, width, pairs }) {
    return (episode) => {
      const lifted = inverse[0].map(() => 0);
      seen(episode).forEach((o, i) => inverse[i].forEach((x, j) => (lifted[j] += (o - zero[i]) * x)));
      const state = lifted.slice(0, states);
      for (const [i, j] of pairs) state[i] = Math.atan2(lifted[j + 1], lifted[j]);
      return [state, lifted[width]];
    };
  }

  const affine = (x, weight, bias) =>
    Float64Array.from(bias.n, (start, row) => x.reduce((sum, v, i) => sum + v * weight.n[row * x.length + i], start));

  /** Observations as a network's input. */
  function normaliser({ normalise }, { obs_mean: mean, obs_var: variance }) {
    if (!normalise) return (x) => x;
    const { epsilon, clip } = normalise;
    return (x) => x.map((v, i) => clamp((v - mean.n[i]) / Math.sqrt(variance.n[i] + epsilon), -clip, clip));
  }

  /** The output of a network's layers. */
  function layers(about, arrays) {
    const { activation, bins, choices, controls, largest, mean_limit: limit } = about;
    return (x) => {
      for (let k = 0; k < about.layers; k++) {
        x = affine(x, arrays[`weight_${k}`], arrays[`bias_${k}`]);
        if (k + 1 < about.layers) x = x.map(ACTIVATIONS[activation]);
      }
      if (choices.length) return x;
      if (bins) {
        return Array.from({ length: controls }, (_, i) =>
          largest * ((2 * indexOfLargest(x.subarray(i * bins, (i + 1) * bins)) + 1) / bins - 1));
      }
      if (limit) x = x.map((v) => clamp(v, -limit, limit));
      return about.squash === "tanh" ? x.map((v) => largest * Math.tanh(v)) : x;
    };
  }

  function mlp(about, arrays) {
    const [normalised, outputs] = [normaliser(about, arrays), layers(about, arrays)];
    let frames;
    return (episode) => {
      const now = seen(episode);
      if (!episode.steps) frames = Array(about.frames).fill(about.padding === "first" ? now : now.map(() => 0));
      frames = [...frames.slice(1), now];
      return outputs(normalised(Float64Array.from(frames.flatMap((x) => [...x]))));
    };
  }

  function gru(about, arrays) {
    const [normalised, outputs] = [normaliser(about, arrays), layers(about, arrays)];
    const size = about.memory;
    let memory;
    return (episode) => {
      if (!episode.steps) memory = new Float64Array(size);
      const o = affine(normalised(seen(episode)), arrays.weight_ih, arrays.bias_ih);
      const h = affine(memory, arrays.weight_hh, arrays.bias_hh);
      memory = memory.map((old, i) => {
        const [r, z] = [0, size].map((at) => sigmoid(o[at + i] + h[at + i]));
        return (1 - z) * Math.tanh(o[2 * size + i] + r * h[2 * size + i]) + z * old;
      });
      return outputs(memory);
    };
  }

  function feedback(about, { gain, offset }) {
    return (episode) => {
      const x = seen(episode);
      return Float64Array.from(offset.n, (start, j) => x.reduce((sum, v, i) => sum + v * gain.n[i * offset.n.length + j], start));
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
    return (episode) => {
      const now = Math.min(episode.steps, length - 1);
      const off = read(episode)[0].map((x, i) => x - states.n[now * wide + i]);
      for (const i of wrapped) off[i] -= 2 * Math.PI * rounded(off[i] / (2 * Math.PI));
      return Array.from({ length: many }, (_, j) =>
        actions.n[now * many + j] - off.reduce((sum, x, i) => sum + gains.n[(now * many + j) * wide + i] * x, 0));
    };
  }

  function table(about, arrays) {
    const axes = about.axes.map((_, j) => arrays[`axis_${j}`].n);
    const values = arrays.table.n;
    const read = reader(about.read);
    const strides = axes.map((_, j) => axes.slice(j + 1).reduce((product, axis) => product * axis.length, 1));

    /** The table's number at a moment, and whether it is from the mirror image. */
    function lookUp(state, target, steps) {
      const given = [...state, target, steps * about.interval];
      for (const [i] of about.read.pairs) given[i] -= 2 * Math.PI * Math.round(given[i] / (2 * Math.PI));
      const points = about.sums.map((row) => row.reduce((sum, s, i) => sum + (s ? s * given[i] : 0), 0));
      const mirrored = about.mirror !== null && points[about.mirror] < 0;
      const cells = points.map((x, j) => {
        const [axis, at] = [axes[j], mirrored && about.axes[j] !== "time" ? -x : x];
        let cell = 0;
        for (let high = axis.length - 1; high - cell > 1;) {
          const middle = (cell + high) >> 1;
          if (axis[middle] <= at) cell = middle;
          else high = middle;
        }
        return [cell, clamp((at - axis[cell]) / (axis[cell + 1] - axis[cell]), 0, 1)];
      });
      let total = 0;
      for (let corner = 0; corner < 1 << cells.length; corner++) {
        let [weight, index] = [1, 0];
        cells.forEach(([cell, place], j) => {
          const upper = (corner >> j) & 1;
          weight *= upper ? place : 1 - place;
          index += (cell + upper) * strides[j];
        });
        if (weight) total += weight * values[index];
      }
      return [total, mirrored];
    }

    if (about.kind === "action table") {
      return (episode) => {
        const [found, mirrored] = lookUp(...read(episode), episode.steps);
        return [mirrored ? about.sign * found : found];
      };
    }

    /** The values of actions: the reward of a step from the observed state, plus the value where it ends. */
    function worth(episode, actions) {
      const { functions, about: code } = episode.code;
      const [state, target] = read(episode);
      const before = Float64Array.from(episode.f);
      before.set(state);
      before.fill(target, ...code.rows.g);
      functions.lift(before, episode.k);
      const after = new Float64Array(before.length);
      return actions.map((action) => {
        after.set(before);
        functions.move(after, [action], episode.k);
        const later = after[code.rows.ended] > 0 ? 0 : lookUp(after.subarray(0, code.states), target, episode.steps + 1)[0];
        return after[code.rows.reward] + later;
      });
    }

    const { choices, largest } = about;
    if (choices.length) return (episode) => worth(episode, [...Array(choices[0]).keys()]);
    const spaced = (n) => Array.from({ length: n }, (_, i) => -1 + (2 * i) / (n - 1));
    const best = (episode, actions) => actions[indexOfLargest(worth(episode, actions))];
    return (episode) => {
      const coarse = best(episode, spaced(about.actions).map((x) => largest * x));
      const width = (2 * largest) / (about.actions - 1);
      return [best(episode, spaced(17).map((x) => clamp(coarse + width * x, -largest, largest)))];
    };
  }

  // --- the player's input ----------------------------------------------------------------------------------

  const PAIRS = [["ArrowLeft", "ArrowRight"], ["ArrowDown", "ArrowUp"], ["a", "d"], ["s", "w"]];
  const NAMES = { ArrowLeft: "←", ArrowRight: "→", ArrowDown: "↓", ArrowUp: "↑" };
  const nameOf = (key) => NAMES[key] ?? key.toUpperCase();

  /** Keys, pointer and gamepad as numbers per control. */
  class Hands {
    constructor(about, lost) {
      [this.about, this.lost] = [about, lost];
      this.pressed = new Set();
      this.pointer = null;
      this.pad = null;
    }

    get pairs() {
      return PAIRS.slice(0, this.about.controls.length);
    }

    release() {
      this.pressed.clear();
      this.pointer = null;
    }

    /** The gamepad's input, [-1, 1] per axis; null without one, or if it is not touched. */
    readPad() {
      if (this.pad === null) return null;
      const pad = navigator.getGamepads?.()[this.pad];
      if (!pad?.connected) {
        this.pad = null;
        this.lost();
        return null;
      }
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
    const { make, find, text, symbol, fit, paint, placed, windowOf, posesAt, load, calm } = tools;
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
    const link = make("input", { type: "text", readonly: "", "aria-label": "Link of this drive" });
    const copy = button("copy", "Copy link");
    const share = make("div", { class: "share" }, link, copy);
    const panel = make("details", { class: "sliders" }, make("summary", {}, "Change the machine (not scored)"));
    root.replaceChildren(stage, bar, readout, verdict, share, panel, said);
    share.hidden = watch.hidden = episodeLabel.hidden = true;

    const hands = new Hands(about, () => {
      if (running) pause();
      tell("The gamepad is disconnected. Drive with the keys, or connect it again; Space continues.");
    });
    const named = (name) => hands.pairs.map(([down, up], i) => `${nameOf(down)} ${nameOf(up)} ${name(about.controls[i].name)}`).join(", ");
    const how = named(symbol);
    stage.setAttribute("aria-label", `Drive ${board.id}. ${named((name) => name.replace(/_/g, " ")) || "Nothing acts here"}. Space pauses, R restarts, N is another start.`);

    let { constants } = code;
    let seed = big(Math.floor(Math.random() * 2 ** 32));
    let me = new Episode(code, seed, constants);
    let mine = [];
    let ghost = null;
    let linked = null;
    let rerunning = null;
    let running = false;
    let [before, left, shownAt] = [0, 0, 0];
    let [past, now] = [me.poses(), me.poses()];
    let picture = board.picture;
    const untouched = () => constants === code.constants;
    const finished = (episode) => episode.over === "terminated" || episode.over === "truncated";
    const ended = () => Boolean(me.over || (rerunning && !rerunning.keys[me.steps]));

    /** A return, and its score if the episode is whole: where rewards are costs, a part of it looks too good. */
    const resultOf = (episode) => `return ${text(episode.total, 2)}${known && finished(episode) ? `, score ${text(scoreOf(episode.total))}` : ""}`;

    const tell = (words) => {
      message.textContent = words;
      said.textContent = words;
    };

    // --- ghosts

    /** The ghost: an agent, stored episodes, or the keys of a link. */
    const GHOSTS = {
      live: (row) => load(board.rows[row].live).then((data) => {
        const act = agentOf(data);
        return { name: board.rows[row].name, act: (episode) => act(episode) };
      }),
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
          episodeSelect.replaceChildren(...ghost.replays.map((replay, i) => option(String(i), `${replay.label ?? "episode"}, return ${text(replay.return, 2)}`)));
          episodeLabel.hidden = false;
          chooseEpisode();
          return;
        }
        if (ghost.seed !== undefined) seed = ghost.seed;
      }
      restart();
      if (ghost?.act) warmUp();
    }

    function chooseEpisode() {
      ghost.replay = ghost.replays[Number(episodeSelect.value)] ?? ghost.replays[0];
      if (ghost.replay.reset_seed !== undefined) seed = big(ghost.replay.reset_seed);
      else tell("The seed of this episode is not known: the ghost starts elsewhere.");
      restart();
    }

    function startGhost() {
      if (!ghost) return;
      if (ghost.act) {
        ghost.episode = new Episode(code, seed, constants);
        ghost.past = ghost.now = ghost.episode.poses();
      }
    }

    function stepGhost() {
      if (!ghost?.act || ghost.episode.over || ghost.episode.steps >= ghost.steps) return;
      ghost.past = ghost.now;
      ghost.episode.step(ghost.act(ghost.episode));
      ghost.now = ghost.episode.poses();
    }

    /** The ghost's poses and return within the current step. */
    function ghostAt(part) {
      if (!ghost) return null;
      if (ghost.act) return { poses: mixedPoses(ghost.past, ghost.now, ghost.episode.over ? 1 : part), total: ghost.episode.total };
      const { replay } = ghost;
      if (!replay?.poses) return null;
      const exact = clamp(me.steps - 1 + part, 0, replay.end);
      const moment = Math.floor(exact);
      return { poses: posesAt(replay.poses, board.picture.units, moment, exact - moment), total: replay.sums[moment] };
    }

    // --- time

    const mixedPoses = (a, b, part) => b.map((frame, i) => frame.map((x, j) => (j < 3 ? a[i][j] + (x - a[i][j]) * part : x)));

    /** Keep the seed in the address, unless a link there already has it. */
    function note() {
      if (seed !== linked?.seed) history.replaceState(null, "", `#seed=${seed}`);
    }

    function restart() {
      me = new Episode(code, seed, constants);
      mine = [];
      past = now = me.poses();
      left = 0;
      share.hidden = true;
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
      const [trial, act] = [new Episode(code, seed, constants), ghost?.act ?? (() => about.rest)];
      let steps = 0;
      const more = () => {
        if (running || me.steps) return; // an agent may have a memory that reaches back to the start of its episode
        const end = performance.now() + 2;
        do {
          if (trial.over) trial.restart(big(steps));
          trial.step(act(trial));
          trial.poses();
          steps += 1;
        } while (performance.now() < end);
        if (steps < WARM) idly(more);
      };
      idly(more);
    }

    function tick() {
      const key = rerunning ? rerunning.keys[me.steps] : hands.numbers();
      if (!key) {
        finish("The link's keys end here");
        return;
      }
      past = now;
      me.step(actionOf(key, about));
      if (me.over !== "refused") mine.push(key);
      now = me.poses();
      stepGhost();
      if (me.over) finish();
    }

    function finish(words = "") {
      running = false;
      label();
      const ending = words || { terminated: "The episode has ended", truncated: "Time is up", refused: "The next step was refused, because it cannot be computed to full accuracy" }[me.over];
      const result = untouched() ? resultOf(me) : `return ${text(me.total, 2)}, not scored`;
      const beside = ghost && ghostAt(1) ? `; ${ghost.name}: return ${text(ghostAt(1).total, 2)} by then` : "";
      tell(`${ending}: ${result}${beside}. R: ${rerunning ? "drive from this start" : "again"}, N: another start.`);
      offer();
    }

    /** Offer the link of this drive. */
    function offer() {
      if (!untouched() || !mine.length || rerunning) return;
      link.value = writeLink(about, seed, mine, me.total, location.href.replace(/#.*/, ""));
      share.hidden = false;
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
      go.textContent = running ? "Pause" : ended() ? "Start again" : me.steps ? "Resume" : "Start";
    }

    function run() {
      if (running) return;
      running = true;
      note();
      message.textContent = rerunning ? "Watching the link's drive: you do not steer. Space pauses, R lets you drive." : "";
      said.textContent = message.textContent || "Driving";
      share.hidden = true;
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
      const { pen, width, height } = fit(canvas);
      pen.clearRect(0, 0, width, height);
      if (width && picture && about.frames) {
        const box = { x: 8, y: 8, width: width - 16, height: height - 16 };
        const poses = mixedPoses(past, now, part);
        const seenFrom = windowOf(picture, poses);
        paint(pen, box, seenFrom, placed(picture, poses, seenFrom));
        const beside = ghostAt(part);
        if (beside) {
          pen.globalAlpha = 0.35;
          paint(pen, box, seenFrom, placed(picture, beside.poses, seenFrom), ["body", "mark"]);
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

    const cells = new Map();

    function readOut(beside) {
      const score = known && (finished(me) ? text(scoreOf(me.total)) : !ended() && "at the end") || "–";
      const keys = rerunning ? rerunning.keys[Math.max(0, me.steps - 1)] ?? [] : mine[mine.length - 1] ?? [];
      const entries = [
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
      ];
      if ([...cells.keys()].join() !== entries.map(([name]) => name).join()) {
        cells.clear();
        readout.replaceChildren(...entries.map(([name]) => {
          cells.set(name, make("dd"));
          return make("div", {}, make("dt", {}, name), cells.get(name));
        }));
      }
      for (const [name, value] of entries) if (cells.get(name).textContent !== value) cells.get(name).textContent = value;
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
        change();
        picture = look();
        rerunning = null;
        restart();
        tell(untouched() ? "The machine is as it was: drives are scored again." : "The machine was changed: this drive is not scored.");
      });
      panel.append(make("label", {}, make("span", {}, name), input, output));
      return { slider, input, say };
    });

    /** Apply the sliders' values and all that follows from them. */
    function change() {
      const values = inputs.map(({ say }) => say());
      constants = code.constants;
      if (inputs.every(({ input }) => Number(input.value) === 0)) return;
      constants = Float64Array.from(code.constants);
      inputs.forEach(({ slider }, i) => (constants[slider.at] = values[i]));
      code.functions.derive(constants);
    }
    const reset = button("reset", "Reset");
    reset.addEventListener("click", () => {
      for (const { input } of inputs) input.value = "0";
      change();
      picture = look();
      restart();
      tell("The machine is as it was: drives are scored again.");
    });
    panel.append(reset);
    panel.hidden = !inputs.length;

    // --- links

    /** Recompute a link's drive, a little in each frame, and tell whether its claim is true. */
    function checkLink(hash) {
      linked = rerunning = null;
      watch.hidden = true;
      if (ghostSelect.value.startsWith("link:")) {
        ghostSelect.value = "";
        ghost = null;
      }
      listGhosts();
      let told;
      try {
        told = readLink(hash, about);
      } catch (error) {
        verdict.textContent = String(error.message);
        verdict.dataset.true = "false";
        return;
      }
      const episode = new Episode(code, told.seed);
      verdict.textContent = "The link is being recomputed …";
      delete verdict.dataset.true;
      const go = () => {
        const until = performance.now() + 4;
        while (episode.steps < told.keys.length && performance.now() < until) {
          if (episode.over) break;
          episode.step(actionOf(told.keys[episode.steps], about));
        }
        if (episode.steps < told.keys.length && !episode.over) {
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
      rerunning = null;
      restart();
    }

    // --- what people do

    const still = (event) => event.ctrlKey || event.altKey || event.metaKey;

    stage.addEventListener("keydown", (event) => {
      if (still(event) || event.target !== stage) return;
      const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
      const drives = hands.pairs.flat().includes(key) || (/^[1-9]$/.test(key) && about.controls.some((c) => c.values.length));
      if (drives) {
        hands.pressed.add(key);
        if (!running && !ended()) run();
      } else if (key === " ") toggle();
      else if (key === "r") afresh();
      else if (key === "n") another();
      else return;
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
      if (ghost?.replays || ghost?.seed !== undefined) {
        ghostSelect.value = "";
        ghost = null;
        episodeLabel.hidden = true;
      }
      seed = big(Math.floor(Math.random() * 2 ** 32));
      afresh();
    }

    function point(event) {
      const box = canvas.getBoundingClientRect();
      const across = (event.clientX - box.left - box.width / 2) / (0.42 * box.width);
      const up = (box.top + box.height / 2 - event.clientY) / (0.42 * box.height);
      hands.pointer = [clamp(across, -1, 1), clamp(up, -1, 1)];
    }

    canvas.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      canvas.setPointerCapture?.(event.pointerId);
      stage.focus({ preventScroll: true });
      if (!running) toggle();
      point(event);
      event.preventDefault();
    });
    canvas.addEventListener("pointermove", (event) => hands.pointer && point(event));
    for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
      canvas.addEventListener(name, () => (hands.pointer = null));
    }
    const take = (pad) => {
      hands.pad = pad.index;
      tell("A gamepad is connected: drive with its stick.");
    };
    window.addEventListener("gamepadconnected", (event) => take(event.gamepad));
    window.addEventListener("gamepaddisconnected", () => hands.readPad());
    document.addEventListener("visibilitychange", () => document.hidden && running && pause());

    for (const [pressed, act] of [[go, toggle], [again, afresh], [fresh, another]]) {
      pressed.addEventListener("click", () => {
        act();
        if (running) stage.focus({ preventScroll: true });
      });
    }
    watch.addEventListener("click", () => {
      running = false;
      ghostSelect.value = "";
      ghost = null;
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
    const nothing = picture && about.frames ? "" : " This scene has nothing to draw; the numbers show how it moves.";
    tell(`${how ? `${how}; or use the pointer or a gamepad.` : "There is nothing to control here: just watch."} Space starts.${nothing}`);
    if (calm.matches) speed.value = "0.5";
    const there = [...(navigator.getGamepads?.() ?? [])].find((pad) => pad?.connected);
    if (there) take(there);
    followHash();
    return { show: () => show(1), get episode() { return me; } };
  }

  const api = { Episode, agentOf, readLink, writeLink, hexOf, actionOf, lacking, open };
  if (typeof module === "object") module.exports = api;
  else window.lagEnvs.put(api);
})();
