"use strict";
/* The leaderboard's page. Plain JavaScript without a build step or other hosts; it works from file: too.
 *
 * Submissions are untrusted: their contents become text (textContent) or numbers, never markup.
 *
 * In this order: helpers, scenes, painting, player, phase portraits, ranking, charts, drive, overview, menu, start.
 * Driving itself is in episode.js and drive.js, which are loaded on demand.
 */
(() => {
  const TURN = 2 * Math.PI;
  const SVG = "http://www.w3.org/2000/svg";
  const COLOURS = 8;
  const find = (selector, root = document) => root.querySelector(selector);
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const calm = matchMedia("(prefers-reduced-motion: reduce)");

  // --- helpers ---------------------------------------------------------------------------------------------

  /** A function that makes an element: attributes are set as such, children are elements or text. */
  const maker = (create) => (name, attributes = {}, ...children) => {
    const element = create(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  };
  const make = maker((name) => document.createElement(name));
  const draw = maker((name) => document.createElementNS(SVG, name));

  /** Write names and values into a list; elements are reused, so that the layout does not jump with every frame. */
  function writeList(list, entries) {
    const names = [...list.children].map((row) => row.firstChild.textContent);
    if (names.join() !== entries.map(([name]) => name).join()) {
      list.replaceChildren(...entries.map(([name]) => make("div", {}, make("dt", {}, name), make("dd"))));
    }
    entries.forEach(([, value], i) => {
      const cell = list.children[i].lastChild;
      if (cell.textContent !== value) cell.textContent = value;
    });
  }

  const isNumber = (x) => typeof x === "number" && Number.isFinite(x);
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
  const mix = (a, b, share) => a + (b - a) * share;
  const distance = ([ax, ay], [bx, by]) => Math.hypot(bx - ax, by - ay);

  function text(x, digits = 3) {
    if (!isNumber(x)) return "–";
    const words = x.toFixed(digits);
    return Number(words) === 0 ? words.replace("-", "") : words.replace("-", "−");
  }

  function count(x) {
    for (const [size, sign] of [[1e9, "G"], [1e6, "M"], [1e3, "k"]]) {
      if (x >= size) return `${+(x / size).toPrecision(3)} ${sign}`;
    }
    return String(+x.toPrecision(3));
  }

  /** About `wanted` multiples of a round step between two numbers. */
  function ticks(low, high, wanted = 4) {
    const rough = (high - low) / wanted;
    if (!(rough > 0) || !Number.isFinite(rough)) return { step: 1, at: [low] };
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * ([1, 2, 5, 10].find((x) => x * power >= 0.7 * rough) ?? 10);
    return { step, at: multiples(low, high, step) };
  }

  /** Multiples of a step that lie between two numbers. */
  function multiples(low, high, step) {
    const found = [];
    for (let i = Math.ceil(low / step - 1e-6); i <= Math.floor(high / step + 1e-6); i++) found.push(i * step);
    return found;
  }

  const digitsOf = (step) => clamp(Math.ceil(-Math.log10(step) - 1e-6), 0, 6);
  const GREEK = { theta: "θ", psi: "ψ", phi: "φ" };

  /** "theta_1" as θ₁, "theta_dot" as dθ/dt, "psi''" as d²ψ/dt², whose dots are lost in small print; others as words. */
  function symbol(name) {
    const [, base, index = "", rate = ""] = name.match(/^(.+?)(?:_(\d+))?(_d+ot|'+)?$/) ?? ["", name];
    const order = rate.startsWith("'") ? rate.length : rate.length && rate.length - 3;
    const lower = index.replace(/\d/g, (digit) => String.fromCharCode(0x2080 + Number(digit)));
    const words = (GREEK[base] ?? base.replace(/_/g, " ")) + lower;
    if (!order) return words;
    const power = order > 1 ? "⁰¹²³⁴⁵⁶⁷⁸⁹"[order] : "";
    return `d${power}${base.length > 1 && !GREEK[base] ? `(${words})` : words}/dt${power}`;
  }

  // --- scenes ----------------------------------------------------------------------------------------------
  // An environment's shapes lie in frames, [what, frame, ..., role], in metres, x to the right and y up; an
  // episode says where the frames are. Nothing here depends on what the scene is.

  /** Numbers of a column, which holds the second differences of whole multiples of a unit. */
  function unpack(column, length, unit) {
    const values = new Float64Array(length);
    if (!Array.isArray(column)) return values.fill(column * unit);
    let [step, value] = [0, 0];
    for (let i = 0; i < length; i++) {
      step += column[i];
      value += step;
      values[i] = value * unit;
    }
    return values;
  }

  /** Poses with their columns unpacked. */
  const prepared = ({ columns, frames }, length) => ({ columns: columns.map((c) => unpack(c, length, 1)), frames });

  /** Where the frames are, [x, y, angle, part]: recorded poses at a moment, mixed with a share of the next. */
  function posesAt({ columns, frames }, units, moment, share = 0) {
    return frames.map((frame) => frame.map((c, i) => {
      const values = columns[c];
      // A control stays the same during a step.
      const next = i < 3 ? Math.min(moment + 1, values.length - 1) : moment;
      return units[i] * mix(values[moment], values[next], share);
    }));
  }

  const lengthOf = (points) => points.slice(1).reduce((sum, point, i) => sum + distance(points[i], point), 0);

  /** The first part of a line. */
  function beginning(points, part) {
    if (part >= 1) return points;
    let room = part * lengthOf(points);
    const kept = [points[0]];
    for (let i = 1; i < points.length; i++) {
      const [a, b] = [points[i - 1], points[i]];
      const step = distance(a, b);
      if (step >= room) {
        const share = step ? room / step : 0;
        return [...kept, [mix(a[0], b[0], share), mix(a[1], b[1], share)]];
      }
      kept.push(b);
      room -= step;
    }
    return kept;
  }

  /** Shapes of frames as shapes of the plane: [what, points or centre, (radius,) role]. */
  function placed({ shapes }, poses, view) {
    return shapes.flatMap(([what, frame, ...given]) => {
      const [x, y, angle, part] = poses[frame];
      const [cos, sin, way] = [Math.cos(angle), Math.sin(angle), part < 0 ? -1 : 1];
      const move = ([a, b]) => [x + cos * a - sin * way * b, y + sin * a + cos * way * b];
      if (what === "circle" || what === "magnifier") return [[what, move(given[0]), ...given.slice(1)]];
      if (what === "ruler") {
        const [step, size, role] = given;
        const [left, bottom, right, top] = view;
        const middle = cos * ((left + right) / 2 - x) + sin * ((bottom + top) / 2 - y);
        const far = 2 * Math.max(right - left, top - bottom);
        const at = multiples(middle - far, middle + far, step);
        return at.map((a) => ["line", [move([a, 0]), move([a, -size])], role]);
      }
      const points = what === "polygon" ? given[0] : beginning(given[0], Math.abs(part));
      return [[what, points.map(move), given[1]]];
    });
  }

  /** The parts of a picture that are elsewhere at another moment: bodies, marks, moved parts of the frame. */
  function apart(picture, poses, others) {
    const moved = (i) => [0, 1, 2].some((j) => poses[i][j] !== others[i][j]);
    const shapes = picture.shapes.filter((shape) => {
      const role = shape[shape.length - 1];
      return role === "body" || role === "mark" || (role === "frame" && moved(shape[1]));
    });
    return { ...picture, shapes };
  }

  /** The part of the plane to look at, [left, bottom, right, top]. */
  function windowOf({ window: [left, bottom, right, top], follows }, poses) {
    const [x, y] = follows === null ? [0, 0] : poses[follows];
    return [left + x, bottom + y, right + x, top + y];
  }

  // --- painting --------------------------------------------------------------------------------------------

  let ink = {};

  /** Read the colours of the style sheet, which depend on the reader's choice of light or dark. */
  function readColours() {
    const style = getComputedStyle(document.documentElement);
    const get = (name) => style.getPropertyValue(`--${name}`).trim();
    const names = ["paper", "card", "ink", "soft", "line", "accent", "value-low", "value-mid", "value-high"];
    ink = Object.fromEntries(names.map((name) => [name, get(name)]));
    ink.series = Array.from({ length: COLOURS }, (_, i) => get(`c${i}`));
    ink.roles = {
      body: [get("body-fill"), get("body-edge"), 1.5],
      mark: [get("body-edge"), get("body-edge"), 0],
      hole: [get("stage"), get("frame-edge"), 1.2],
      ground: [get("ground-fill"), get("ground-edge"), 1.2],
      frame: [get("frame-fill"), get("frame-edge"), 1.5],
      guide: [null, get("guide"), 1, [4, 4]],
      target: [null, get("target"), 1.8, [6, 4]],
      limit: [get("limit"), get("limit"), 2.5],
      action: [get("accent"), get("accent"), 4],
    };
  }

  /** Fit a canvas to its place on the screen; returns its context, width and height in CSS pixels. */
  function fit(canvas) {
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const ratio = Math.min(window.devicePixelRatio || 1, 3);
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    return { pen, width, height };
  }

  /** Fit a canvas and clear it. */
  function cleared(canvas) {
    const fitted = fit(canvas);
    fitted.pen.clearRect(0, 0, fitted.width, fitted.height);
    return fitted;
  }

  /** Draw only within a rectangle, until the pen is restored. */
  function clip(pen, x, y, width, height) {
    pen.save();
    pen.beginPath();
    pen.rect(x, y, width, height);
    pen.clip();
  }

  function trace(pen, points, closed) {
    pen.beginPath();
    points.forEach(([x, y], i) => (i ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    if (closed) pen.closePath();
  }

  function paint(pen, box, view, shapes, only = null) {
    const [left, bottom, right, top] = view;
    const scale = Math.min(box.width / (right - left), box.height / (top - bottom));
    const [x0, y0] = [box.x + box.width / 2, box.y + box.height / 2];
    const at = ([x, y]) => [x0 + scale * (x - (left + right) / 2), y0 - scale * (y - (bottom + top) / 2)];
    pen.lineJoin = "round";
    for (const [what, a, b, c] of shapes) {
      const role = what === "circle" ? c : b;
      if (what === "magnifier") {
        if (!only) magnify(pen, box, at(a), scale, a, b, shapes);
        continue;
      }
      if (only && !only.includes(role)) continue;
      const [fill, edge, width, dash = []] = ink.roles[role];
      pen.lineWidth = width;
      pen.setLineDash(dash);
      pen.strokeStyle = edge;
      pen.fillStyle = fill ?? "transparent";
      if (what === "arrow") {
        arrow(pen, a.map(at), width, edge);
        continue;
      }
      if (what === "circle") {
        const [x, y] = at(a);
        pen.beginPath();
        pen.arc(x, y, scale * b, 0, TURN);
      } else {
        trace(pen, a.map(at), what === "polygon");
      }
      if (fill && what !== "line") pen.fill();
      if (width) pen.stroke();
    }
    pen.setLineDash([]);
  }

  /** An arrow as long as its points say; a short one is thinner. */
  function arrow(pen, points, full, colour) {
    const length = lengthOf(points);
    if (length < 1.5) return;
    const width = full * Math.min(1, length / (4 * full));
    const shaft = beginning(points, 1 - (3 * width) / length);
    const [tip, end] = [points[points.length - 1], shaft[shaft.length - 1]];
    const [dx, dy] = [(tip[0] - end[0]) / 2, (tip[1] - end[1]) / 2];
    pen.lineWidth = width;
    trace(pen, shaft, false);
    pen.stroke();
    pen.fillStyle = colour;
    trace(pen, [tip, [end[0] - dy, end[1] + dx], [end[0] + dy, end[1] - dx]], true);
    pen.fill();
  }

  /** Show a part of the picture once more in its upper right corner. */
  function magnify(pen, box, small, scale, centre, radius, shapes) {
    const size = 0.36 * Math.min(box.width, box.height);
    const middle = [box.x + box.width - size / 2 - 12, box.y + size / 2 + 12];
    pen.save();
    pen.beginPath();
    pen.arc(...middle, size / 2, 0, TURN);
    pen.fillStyle = ink.roles.hole[0];
    pen.fill();
    pen.clip();
    const [x, y] = centre;
    const glass = { x: middle[0] - size / 2, y: middle[1] - size / 2, width: size, height: size };
    const near = shapes.filter((shape) => shape[0] !== "magnifier");
    paint(pen, glass, [x - radius, y - radius, x + radius, y + radius], near);
    pen.restore();
    pen.strokeStyle = ink.roles.guide[1];
    pen.lineWidth = 1.2;
    for (const [at, r] of [[middle, size / 2], [small, radius * scale]]) {
      pen.beginPath();
      pen.arc(...at, r, 0, TURN);
      pen.stroke();
    }
  }

  /** Poses of an episode in one picture, like a multiple exposure. */
  function poster(canvas, { picture, poster: still }) {
    const { pen, width, height } = fit(canvas);
    if (!width || !picture || !still?.poses) return;
    pen.clearRect(0, 0, width, height);
    const n = still.count;
    const poses = prepared(still.poses, n);
    const at = Array.from({ length: n }, (_, i) => posesAt(poses, picture.units, i));
    const view = windowOf(picture, at[n - 1]);
    const box = { x: 0.02 * width, y: 0.02 * height, width: 0.96 * width, height: 0.96 * height };
    const last = placed(picture, at[n - 1], view).filter(([what]) => what !== "magnifier");
    paint(pen, box, view, last, ["ground", "frame", "guide", "target", "limit", "hole"]);
    at.forEach((now, i) => {
      pen.globalAlpha = i === n - 1 ? 1 : mix(0.1, 0.45, i / n);
      paint(pen, box, view, placed(apart(picture, now, at[n - 1]), now, view));
    });
    pen.globalAlpha = 1;
  }

  /** Show an episode in place of its poster, in a loop, unless the reader prefers reduced motion. */
  function startFilm() {
    const canvas = find(".hero [data-poster]");
    const button = find(".film");
    if (!canvas || !button || !board.film || !board.picture) return;
    let [replay, running, seen, begun] = [null, !calm.matches, true, 0];
    const frame = (now) => {
      if (!running || !seen) return;
      begun ||= now;
      // The film pauses while somebody drives, because it would slow down the drive.
      if (find(".stage[data-driving]")) {
        requestAnimationFrame(frame);
        return;
      }
      const length = replay.end * replay.dt;
      const time = Math.min(((now - begun) / 1000) % (length + 1), length);
      const at = Math.min(Math.floor(time / replay.dt), replay.end - 1);
      const poses = posesAt(replay.poses, board.picture.units, at, Math.min(time / replay.dt - at, 1));
      const { pen, width, height } = cleared(canvas);
      const view = windowOf(board.picture, poses);
      const box = { x: 0.02 * width, y: 0.02 * height, width: 0.96 * width, height: 0.96 * height };
      if (width) paint(pen, box, view, placed(board.picture, poses, view));
      requestAnimationFrame(frame);
    };
    const show = () => {
      button.textContent = running ? "Pause the episode" : "Play the episode";
      begun = 0;
      if (running && replay) requestAnimationFrame(frame);
      else poster(canvas, board);
    };
    button.addEventListener("click", () => {
      running = !running;
      show();
    });
    episodes(board.film).then((replays) => {
      if (!replays[0]?.poses) return;
      [replay, button.hidden] = [replays[0], false];
      new IntersectionObserver(([entry]) => {
        const before = seen;
        seen = entry.isIntersecting;
        if (seen && !before && running) show();
      }).observe(canvas);
      show();
    }, () => {});
  }

  // --- replays ---------------------------------------------------------------------------------------------

  const fetched = new Map();
  const waiting = new Map();

  /** Called by the files in assets/; each holds the episodes of one agent, an agent, or a program. */
  function put(what) {
    waiting.get(document.currentScript?.getAttribute("src"))?.(what);
  }

  const TOO_OLD = "This browser cannot run the page's program. Browsers from the end of 2020 on can.";

  /** Load a file as a script, which works from file:, where fetch does not. */
  function load(file, what = "The program") {
    if (!fetched.has(file)) {
      const promise = new Promise((resolve, reject) => {
        waiting.set(file, resolve);
        const script = make("script", { src: file });
        script.addEventListener("error", () => {
          fetched.delete(file);
          reject(new Error(`${what} could not be loaded. Check the connection and try again.`));
        });
        // By now, the script has delivered its data, unless it could not be run.
        script.addEventListener("load", () => reject(new Error(TOO_OLD)));
        document.head.append(script);
      });
      fetched.set(file, promise);
    }
    return fetched.get(file);
  }

  /** The episodes in a file. */
  const episodes = (file) => load(file, "The episodes").then((replays) => replays.map(prepare));

  /** An episode with its columns unpacked. */
  function prepare(replay) {
    const dt = replay.dt || board.dt || 1;
    const rows = (columns, n) => {
      const values = columns.map((c) => unpack(c, n, replay.unit));
      return Array.from({ length: n }, (_, i) => values.map((v) => v[i]));
    };
    const states = rows(replay.states, replay.steps + 1);
    const actions = rows(replay.actions, replay.steps).map((a) => (a.length === 1 ? a[0] : a));
    const sums = [...unpack(replay.returns, replay.steps + 1, replay.unit)];
    const rewards = sums.slice(1).map((sum, i) => sum - sums[i]);
    const poses = replay.poses && prepared(replay.poses, replay.steps + 1);
    return { ...replay, dt, states, actions, rewards, sums, poses, end: Math.max(1, replay.steps) };
  }

  // --- player ----------------------------------------------------------------------------------------------

  let board = null;

  function startPlayer() {
    const root = find("#watch");
    if (!root) return null;
    const sides = all(".side", root).map((element, index) => ({
      index,
      element,
      agent: find(".agent", element),
      episode: find(".episode", element),
      canvas: find(".scene", element),
      readout: find(".readout", element),
      phase: all(".phase", root)[index],
      row: null,
      replay: null,
      asked: 0,
    }));
    const play = find(".play", root);
    const range = find(".scrub input", root);
    const clock = find(".clock", root);
    const speed = find(".speed select", root);
    const loop = find(".loop input", root);
    const said = find("#said", root);
    const traces = find(".traces canvas", root);
    const pair = find(".pair select", root);
    const pairs = pairsOf(board);
    let time = 0;
    let playing = false;
    let before = 0;
    let saying = 0;
    let soon = 0;

    const step = () => Math.min(...sides.map((side) => side.replay?.dt ?? Infinity), 1);
    const end = () => Math.max(0, ...sides.map((side) => (side.replay ? side.replay.end * side.replay.dt : 0)));

    /** The moment of a side: its frame, and the state between frames while playing slowly. */
    function momentOf({ replay }) {
      const exact = Math.min(time / replay.dt, replay.end);
      const frame = Math.min(Math.floor(exact + 1e-6), replay.end);
      const share = clamp(exact - frame, 0, 1);
      const next = Math.min(frame + 1, replay.end);
      const state = replay.states[frame].map((x, i) => mix(x, replay.states[next][i], share));
      const action = frame > 0 ? replay.actions[frame - 1] : null;
      return {
        frame,
        state,
        action,
        reward: frame > 0 ? replay.rewards[frame - 1] : null,
        total: replay.sums[frame],
        time: frame * replay.dt,
        poses: replay.poses && posesAt(replay.poses, board.picture.units, frame, share),
      };
    }

    function show() {
      soon = 0;
      for (const side of sides) showSide(side);
      const dt = step();
      range.max = Math.max(1, Math.round(end() / dt));
      range.value = Math.round(time / dt - (playing ? 0.5 : 0));
      range.setAttribute("aria-valuetext", `${time.toFixed(2)} of ${end().toFixed(2)} seconds`);
      root.style.setProperty("--done", `${end() ? (100 * time) / end() : 0}%`);
      clock.textContent = `${time.toFixed(2)} / ${end().toFixed(2)} s`;
      drawTraces(traces, sides, time, end());
    }

    function later() {
      soon ||= requestAnimationFrame(show);
    }

    function showSide(side) {
      const { pen, width, height } = cleared(side.canvas);
      if (!side.replay) {
        writeList(side.readout, []);
        cleared(side.phase);
        return;
      }
      const now = momentOf(side);
      if (width && now.poses) {
        const box = { x: 8, y: 8, width: width - 16, height: height - 16 };
        const view = windowOf(board.picture, now.poses);
        paint(pen, box, view, placed(board.picture, now.poses, view));
      }
      const over = now.frame >= side.replay.end;
      writeList(side.readout, [
        ["Time", `${text(now.time, 2)} s${over ? ", end" : ""}`],
        ["Action", [now.action].flat().map((v) => text(v)).join(", ")],
        ["Reward", text(now.reward)],
        ["Return", text(now.total, 2)],
        ...board.state_names.map((name, i) => {
          return [symbol(name), `${text(now.state[i], 2)} ${board.state_units[i] ?? ""}`];
        }),
      ]);
      const chosen = pairs[pair.value] ?? pairs[0];
      if (chosen) drawPhase(side, chosen, now, board, sides);
    }

    /** Describe the picture to screen readers once it is at rest. */
    function say(prefix = "") {
      clearTimeout(saying);
      saying = setTimeout(() => {
        const parts = sides.filter((side) => side.replay).map((side) => {
          const now = momentOf(side);
          const states = board.state_names.map((n, i) => `${n.replace(/_/g, " ")} ${text(now.state[i], 2)}`);
          const words = `${"AB"[side.index]}, ${board.rows[side.row].name}, at ${text(now.time, 2)} seconds: ` +
            `action ${[now.action].flat().map((v) => text(v, 2)).join(", ")}, reward ${text(now.reward, 2)}, return ${text(now.total, 1)}, ` +
            states.join(", ");
          side.canvas.setAttribute("aria-label", words);
          return words;
        });
        said.textContent = prefix + parts.join(". ");
      }, 250);
    }

    function tick(now) {
      if (!playing) return;
      // The first frame's time stamp may be from before the click, and none comes while the page is hidden.
      time += (clamp(now - before, 0, 100) / 1000) * Number(speed.value);
      before = now;
      if (time >= end()) {
        if (loop.checked && end() > 0) time = 0;
        else {
          time = end();
          setPlaying(false);
        }
      }
      show();
      if (playing) requestAnimationFrame(tick);
    }

    function setPlaying(on) {
      if (on && !sides.some((side) => side.replay)) return;
      if (on && time >= end() - 1e-9) time = 0;
      playing = on;
      root.classList.toggle("playing", on);
      play.setAttribute("aria-label", on ? "Pause" : "Play");
      before = performance.now();
      if (on) requestAnimationFrame(tick);
      else {
        // Rest on a recorded state, not between two.
        time = Math.min(Math.round(time / step()) * step(), end());
        later();
        say();
      }
    }

    function seek(to) {
      if (playing) setPlaying(false);
      time = clamp(to, 0, end());
      later();
      say();
    }

    const frames = (by) => seek((Math.round(time / step()) + by) * step());

    async function choose(side, row, episode = 0) {
      const asked = ++side.asked;
      side.agent.value = row === null ? "" : String(row);
      side.episode.replaceChildren();
      side.episode.disabled = row === null;
      if (row === null) {
        [side.row, side.replay] = [null, null];
        side.canvas.setAttribute("aria-label", "No agent");
      } else {
        let replays = [];
        try {
          replays = await episodes(board.rows[row].file);
        } catch (error) {
          said.textContent = String(error.message);
          return;
        }
        // Another agent has been chosen meanwhile.
        if (asked !== side.asked) return;
        [side.row, side.replay] = [row, replays[episode] ?? replays[0]];
        side.episode.replaceChildren(...replays.map((replay, i) => {
          const label = replay.label ? String(replay.label) : "episode";
          const words = `${label[0].toUpperCase()}${label.slice(1)}, return ${text(replay.return, 2)}`;
          return make("option", { value: i }, words);
        }));
        side.episode.value = String(replays[episode] ? episode : 0);
      }
      side.element.dataset.colour = row === null ? "" : row % COLOURS;
      side.background = null;
      time = Math.min(time, end());
      for (const button of all(".pick")) {
        const mine = sides[button.dataset.side];
        const pressed = mine.row === Number(button.closest("tr").dataset.row);
        button.setAttribute("aria-pressed", String(pressed && mine.row !== null));
      }
      later();
      say();
    }

    for (const side of sides) {
      side.agent.addEventListener("change", () => {
        choose(side, side.agent.value === "" ? null : Number(side.agent.value));
      });
      side.episode.addEventListener("change", () => choose(side, side.row, Number(side.episode.value)));
      side.canvas.addEventListener("click", () => setPlaying(!playing));
    }
    play.addEventListener("click", () => setPlaying(!playing));
    for (const button of all(".step", root)) {
      button.addEventListener("click", () => frames(Number(button.dataset.step)));
    }
    range.addEventListener("input", () => seek(Number(range.value) * step()));
    pair.addEventListener("change", () => {
      for (const side of sides) side.background = null;
      later();
    });
    traces.addEventListener("pointerdown", (event) => {
      const box = traces.getBoundingClientRect();
      const { left, right } = lanes(box.width);
      const share = (event.clientX - box.left - left) / (box.width - left - right);
      seek(Math.round((clamp(share, 0, 1) * end()) / step()) * step());
    });

    root.addEventListener("keydown", (event) => {
      const { key, target } = event;
      if (event.ctrlKey || event.altKey || event.metaKey || target.matches("select")) return;
      // The space bar keeps its usual meaning on a button or a box.
      if (key === " " && !target.matches("button, [type=checkbox]")) setPlaying(!playing);
      else if (key === "ArrowLeft" || key === "ArrowDown") frames(event.shiftKey ? -10 : -1);
      else if (key === "ArrowRight" || key === "ArrowUp") frames(event.shiftKey ? 10 : 1);
      else if (key === "Home") seek(0);
      else if (key === "End") seek(end());
      else return;
      // Up and down scroll the page, unless they move the slider.
      if (target === range || !key.match(/^Arrow(Up|Down)$/)) event.preventDefault();
    });

    pair.replaceChildren(...pairs.map((p, i) => make("option", { value: i }, `${p.labels[0]}, ${p.labels[1]}`)));
    pair.closest("label").hidden = pairs.length < 2;
    find(".phases", root).hidden = pairs.length === 0;
    for (const button of all(".pick")) {
      button.addEventListener("click", async () => {
        await choose(sides[button.dataset.side], Number(button.closest("tr").dataset.row));
        root.scrollIntoView({ behavior: calm.matches ? "auto" : "smooth" });
      });
    }

    const ready = board.rows.map((row, i) => (row.file ? i : -1)).filter((i) => i >= 0);
    const other = ready.find((i) => board.rows[i].kind !== board.rows[ready[0]].kind) ?? ready[1];
    // Episodes are large files: load them once the player comes into view, unless some were chosen before.
    new IntersectionObserver((entries, observer) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      observer.disconnect();
      sides.forEach((side, i) => side.asked || choose(side, [ready[0], other ?? null][i]));
    }).observe(root);
    return () => {
      for (const side of sides) side.background = null;
      show();
    };
  }

  const lanes = (width) => ({ left: width < 500 ? 8 : 64, right: 8 });

  /** The curves over time: a name, and the values in an episode; each number of an action has its own curve. */
  function tracesOf(sides) {
    const many = Math.max(1, ...sides.map(({ replay }) => (replay ? [replay.actions[0]].flat().length : 1)));
    const actions = Array.from({ length: many }, (_, k) => ({
      name: many > 1 && board.controls[k] ? symbol(board.controls[k]) : "Action",
      valuesOf: ({ actions }) => actions.map((action) => [action].flat()[k]),
    }));
    return [...actions, { name: "Reward", valuesOf: ({ rewards }) => rewards }];
  }

  /** Actions and reward over time, of both sides, with the present as a line. */
  function drawTraces(canvas, sides, time, end) {
    const shown = tracesOf(sides);
    canvas.style.height = `${4.75 * shown.length}rem`;
    const { pen, width, height } = cleared(canvas);
    if (!width || !end) return;
    const { left, right } = lanes(width);
    const x = (t) => left + ((width - left - right) * t) / end;
    // A name stands beside its lines, or above them where there is no room.
    const beside = left > 20;
    const gap = beside ? 14 : 24;
    const lane = (height - gap * (shown.length - beside)) / shown.length;
    pen.font = `12px ${getComputedStyle(canvas).fontFamily}`;
    shown.forEach(({ name, valuesOf }, i) => {
      const lines = sides.map((side) => (side.replay ? valuesOf(side.replay) : []));
      const values = lines.flat().filter(isNumber);
      const isReward = name === "Reward";
      let [low, high] = isReward ? [0, 0] : [-1, 1];
      for (const v of values) [low, high] = [Math.min(low, v), Math.max(high, v)];
      // One large last reward, such as a penalty, must not flatten all others.
      if (isReward && values.length > 20) {
        const sorted = [...values].sort((a, b) => a - b);
        const [a, b] = [sorted[Math.floor(0.01 * values.length)], sorted[Math.ceil(0.99 * values.length) - 1]];
        [low, high] = [Math.max(low, Math.min(0, a - (b - a))), Math.min(high, Math.max(0, b + (b - a)))];
      }
      if (!(high > low)) high = low + 1;
      const top = i * (lane + gap) + (beside ? 0 : gap);
      const y = (v) => top + 2 + (lane - 4) * (1 - (clamp(v, low, high) - low) / (high - low));
      pen.strokeStyle = ink.line;
      pen.lineWidth = 1;
      for (const v of new Set([low, 0, high])) {
        trace(pen, [[left, y(v)], [width - right, y(v)]], false);
        pen.stroke();
      }
      clip(pen, left, top - 2, width - left - right, lane + 4);
      for (const side of sides) {
        if (!side.replay) continue;
        pen.strokeStyle = ink.series[side.row % COLOURS];
        pen.lineWidth = 1.4;
        pen.setLineDash(side.index ? [4, 2] : []);
        const points = [];
        lines[side.index].forEach((v, j) => {
          if (isNumber(v)) points.push([x(j * side.replay.dt), y(v)], [x((j + 1) * side.replay.dt), y(v)]);
        });
        trace(pen, points, false);
        pen.stroke();
      }
      pen.restore();
      pen.fillStyle = ink.soft;
      pen.textBaseline = "middle";
      pen.textAlign = "left";
      pen.fillText(name, beside ? 0 : left, beside ? top + lane / 2 : top - 10);
    });
    pen.strokeStyle = ink.ink;
    pen.lineWidth = 1.5;
    trace(pen, [[x(Math.min(time, end)), 0], [x(Math.min(time, end)), height]], false);
    pen.stroke();
  }

  // --- phase portraits -------------------------------------------------------------------------------------

  /** The coordinates whose rate is in the state, first the pair of the value function. */
  function pairsOf({ state_names: names, state_units: units, pairs, value }) {
    const found = [...pairs];
    const labels = (value?.axes ?? []).map((axis) => String(axis.label).replace(/\s*[[(].*$/, ""));
    const own = labels.map((label) => names.findIndex((name) => name === label || symbol(name) === label));
    if (own.length === 2 && own.every((i) => i >= 0) && !found.some(([i, j]) => i === own[0] && j === own[1])) {
      found.push(own);
    }
    const shaded = ([i, j]) => i === own[0] && j === own[1];
    found.sort((a, b) => shaded(b) - shaded(a));
    return found.map((pair) => ({
      x: pair[0],
      y: pair[1],
      labels: pair.map((i) => (units[i] ? `${symbol(names[i])} [${units[i]}]` : symbol(names[i]))),
      value: shaded(pair) ? value : null,
      // A bar's angle is drawn within one turn if the value function covers exactly one.
      wraps: shaded(pair) && Math.abs(value.axes[0].high - value.axes[0].low - TURN) < 0.05,
    }));
  }

  function rangeOf(values) {
    let [low, high] = [Infinity, -Infinity];
    for (const v of values) if (isNumber(v)) [low, high] = [Math.min(low, v), Math.max(high, v)];
    if (!(high > low)) [low, high] = [low - 1, low + 1];
    const pad = 0.06 * (high - low);
    return [low - pad, high + pad];
  }

  /** The span of an axis, or only the part that the paths cover if that is much smaller. */
  function nearer([low, high], axis) {
    if (high - low > 0.6 * (axis.high - axis.low)) return [axis.low, axis.high];
    const more = 0.2 * (high - low);
    return [Math.max(low - more, axis.low), Math.min(high + more, axis.high)];
  }

  function drawPhase(side, pair, now, board, sides) {
    const { pen, width, height } = fit(side.phase);
    if (!width) return;
    const box = { left: 46, top: 10, width: width - 56, height: height - 50 };
    const wrap = pair.wraps
      ? (x) => pair.value.axes[0].low + ((((x - pair.value.axes[0].low) % TURN) + TURN) % TURN)
      : (x) => x;
    // Axes, shading and path change only with the choice; only the ring moves.
    const same = ["width", "height"].every((size) => side.background?.[size] === side.phase[size]);
    if (!same) {
      const shown = sides.filter((s) => s.replay).flatMap((s) => s.replay.states);
      let spanX = rangeOf(shown.map((s) => wrap(s[pair.x])));
      let spanY = rangeOf(shown.map((s) => s[pair.y]));
      if (pair.value) {
        const [first, second] = pair.value.axes;
        spanX = pair.wraps ? [first.low, first.high] : nearer(spanX, first);
        spanY = nearer(spanY, second);
      }
      side.background = Object.assign(document.createElement("canvas"), {
        width: side.phase.width,
        height: side.phase.height,
      });
      const back = side.background.getContext("2d");
      back.setTransform(pen.getTransform());
      const x = (v) => box.left + (box.width * (v - spanX[0])) / (spanX[1] - spanX[0]);
      const y = (v) => box.top + box.height * (1 - (v - spanY[0]) / (spanY[1] - spanY[0]));
      Object.assign(side.background, { x, y });
      clip(back, box.left, box.top, box.width, box.height);
      if (pair.value) shade(back, box, pair.value, x, y);
      back.restore();
      axes(back, box, spanX, spanY, pair.labels, x, y, getComputedStyle(side.phase).fontFamily);
      clip(back, box.left, box.top, box.width, box.height);
      back.lineJoin = "round";
      const { states } = side.replay;
      // A light line under the coloured one keeps it readable on any shade.
      for (const [colour, wide] of [[ink.card, 4.5], [ink.series[side.row % COLOURS], 2]]) {
        back.strokeStyle = colour;
        back.lineWidth = wide;
        back.beginPath();
        states.forEach((s, i) => {
          const [px, py] = [x(wrap(s[pair.x])), y(s[pair.y])];
          const jump = i && Math.abs(wrap(s[pair.x]) - wrap(states[i - 1][pair.x])) > Math.PI && pair.wraps;
          if (!i || jump) back.moveTo(px, py);
          else back.lineTo(px, py);
        });
        back.stroke();
      }
      back.restore();
    }
    pen.clearRect(0, 0, width, height);
    pen.drawImage(side.background, 0, 0, width, height);
    const { x, y } = side.background;
    const px = clamp(x(wrap(now.state[pair.x])), box.left, box.left + box.width);
    const py = clamp(y(now.state[pair.y]), box.top, box.top + box.height);
    pen.beginPath();
    pen.arc(px, py, 6, 0, TURN);
    pen.fillStyle = ink.card;
    pen.fill();
    pen.lineWidth = 3;
    pen.strokeStyle = ink.accent;
    pen.stroke();
    const name = `${pair.labels[0]} against ${pair.labels[1]} of ${board.rows[side.row].name}` +
      (pair.value ? ", over the value function" : "");
    if (side.phase.getAttribute("aria-label") !== name) side.phase.setAttribute("aria-label", name);
  }

  const channels = (colour) => [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));

  /** The value function as shades: values[i][j] at the i-th place of the first axis, j-th of the second. */
  function shade(pen, box, { axes: [across, up], values }, x, y) {
    const [nx, ny] = [values.length, values[0].length];
    const columns = values.map((_, i) => x(mix(across.low, across.high, i / (nx - 1))));
    const rows = values[0].map((_, j) => y(mix(up.low, up.high, j / (ny - 1))));
    const within = (at, start, size) => at >= start - 1 && at <= start + size + 1;
    // The shades span the values that are shown.
    let [low, high] = [Infinity, -Infinity];
    values.forEach((column, i) => {
      if (!within(columns[i], box.left, box.width)) return;
      column.forEach((v, j) => {
        if (isNumber(v) && within(rows[j], box.top, box.height)) [low, high] = [Math.min(low, v), Math.max(high, v)];
      });
    });
    if (high < low) return;
    const stops = ["value-low", "value-mid", "value-high"].map((name) => channels(ink[name]));
    const small = Object.assign(document.createElement("canvas"), { width: nx, height: ny });
    const part = small.getContext("2d");
    const image = part.createImageData(nx, ny);
    for (let i = 0; i < nx; i++) {
      for (let j = 0; j < ny; j++) {
        const v = values[i][j];
        if (!isNumber(v)) continue;
        const share = high > low ? clamp((2 * (v - low)) / (high - low), 0, 2) : 1;
        const [a, b] = share < 1 ? [stops[0], stops[1]] : [stops[1], stops[2]];
        const at = 4 * ((ny - 1 - j) * nx + i);
        for (let k = 0; k < 3; k++) image.data[at + k] = mix(a[k], b[k], share < 1 ? share : share - 1);
        image.data[at + 3] = 255;
      }
    }
    part.putImageData(image, 0, 0);
    pen.imageSmoothingEnabled = true;
    pen.imageSmoothingQuality = "high";
    // Values are at the nodes, so the outer half of the outermost pixels lies outside.
    const [left, top] = [x(across.low), y(up.high)];
    const size = [x(across.high) - left, y(up.low) - top];
    pen.drawImage(small, 0.5, 0.5, Math.max(nx - 1, 1), Math.max(ny - 1, 1), left, top, ...size);
  }

  function axes(pen, box, spanX, spanY, labels, x, y, family) {
    const [right, bottom] = [box.left + box.width, box.top + box.height];
    pen.font = `12px ${family}`;
    pen.fillStyle = ink.soft;
    pen.strokeStyle = ink.soft;
    pen.lineWidth = 1;
    pen.textAlign = "center";
    pen.textBaseline = "top";
    const across = ticks(...spanX, Math.max(2, Math.round(box.width / 80)));
    for (const v of across.at) {
      trace(pen, [[x(v), bottom], [x(v), bottom + 4]], false);
      pen.stroke();
      pen.fillText(text(v, digitsOf(across.step)), x(v), bottom + 7);
    }
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const up = ticks(...spanY, 4);
    for (const v of up.at) {
      trace(pen, [[box.left - 4, y(v)], [box.left, y(v)]], false);
      pen.stroke();
      pen.fillText(text(v, digitsOf(up.step)), box.left - 8, y(v));
    }
    pen.strokeRect(box.left, box.top, box.width, box.height);
    pen.textAlign = "center";
    pen.textBaseline = "bottom";
    pen.fillText(`${labels[0]} across, ${labels[1]} up`, box.left + box.width / 2, bottom + 40);
  }

  // --- ranking ---------------------------------------------------------------------------------------------

  /** The mark of a kind, which colour alone does not distinguish: a dot, a square, a diamond. */
  function mark(kind, size = 4.5) {
    if (kind === "controller") {
      return draw("rect", { x: -size, y: -size, width: 2 * size, height: 2 * size, class: "dot" });
    }
    if (kind === "optimal") {
      const r = 1.35 * size;
      return draw("path", { d: `M0 ${-r}L${r} 0L0 ${r}L${-r} 0Z`, class: "dot" });
    }
    return draw("circle", { r: size, class: "dot" });
  }

  function spanOf(rows, optimum, near) {
    const scored = rows.filter((row) => isNumber(row.score)).sort((a, b) => b.score - a.score);
    const chosen = near ? scored.slice(0, Math.max(1, Math.ceil(scored.length / 2))) : scored;
    const low = chosen.map((row) => row.interval?.[0] ?? row.score);
    const high = chosen.map((row) => row.interval?.[1] ?? row.score);
    const ends = near
      ? [Math.min(...low), Math.max(...high, 1)]
      : [Math.min(0, ...low.map((x) => Math.max(x, -0.3))), Math.max(1, ...high.map((x) => Math.min(x, 1.3)))];
    if (near && isNumber(optimum)) ends[1] = Math.max(ends[1], Math.min(optimum, ends[1] + (ends[1] - ends[0])));
    const pad = 0.05 * Math.max(ends[1] - ends[0], 1e-6);
    return [ends[0] - pad, ends[1] + pad];
  }

  const percent = (v, [low, high]) => `${((100 * (v - low)) / (high - low)).toFixed(3)}%`;

  /** Score and interval of a row as a bar on a common axis. */
  function scorePicture(row, span, optimum, marks) {
    const svg = draw("svg", { class: "bar", "aria-hidden": "true", width: "100%", height: "100%" });
    const tick = (v, name) => {
      if (v > span[0] && v < span[1]) {
        svg.append(draw("line", { x1: percent(v, span), x2: percent(v, span), y1: "0", y2: "100%", class: name }));
      }
    };
    svg.append(draw("line", { x1: "0", x2: "100%", y1: "50%", y2: "50%", class: "grid" }));
    for (const v of marks) tick(v, "grid");
    if (isNumber(optimum)) tick(optimum, "optimum");
    if (!isNumber(row.score)) return svg;
    const inside = (v) => clamp(v, ...span);
    if (row.interval && row.interval[1] > span[0]) {
      const [x1, x2] = row.interval.map((v) => percent(inside(v), span));
      svg.append(draw("line", { x1, x2, y1: "50%", y2: "50%", class: "interval" }));
    }
    const place = { x: percent(inside(row.score), span), y: "50%", overflow: "visible" };
    if (row.score >= span[0]) svg.append(draw("svg", place, mark(row.kind)));
    else svg.append(draw("svg", { ...place, x: "0%" }, draw("path", { d: "M8 -5L1 0L8 5Z", class: "dot" })));
    return svg;
  }

  function startRanking() {
    const table = find(".ranking");
    if (!table) return;
    const rows = all("tbody tr", table).map((element) => ({ element, data: board.rows[element.dataset.row] }));
    const body = find("tbody", table);
    const form = find(".filter");
    const order = find("[name=order]", form);
    const status = find("#ranking .status");
    const head = find("th.score", table);
    const axis = make("span", { class: "axis", "aria-hidden": "true" });
    head.append(axis);
    rows.forEach(({ element, data }, i) => {
      element.dataset.colour = i % COLOURS;
      const swatch = draw("svg", { viewBox: "-8 -8 16 16", "aria-hidden": "true" }, mark(data.kind, 5));
      find(".swatch", element).append(swatch);
    });

    function valueOf(data, key) {
      const value = data[key];
      if (key === "name") return String(value).toLowerCase();
      if (key === "success" && value && typeof value === "object") return value.rate ?? null;
      if (value && typeof value === "object") {
        const numbers = Object.values(value).filter(isNumber);
        return numbers.length ? Math.min(...numbers) : null;
      }
      return value ?? null;
    }

    function sort(key, rising) {
      const way = rising ? 1 : -1;
      rows.sort((p, q) => {
        const [a, b] = [valueOf(p.data, key), valueOf(q.data, key)];
        // Missing values come last in either order.
        if (a === null || b === null) return (a === null) - (b === null);
        const less = typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b;
        return way * less || p.element.dataset.row - q.element.dataset.row;
      });
      body.append(...rows.map((row) => row.element));
      for (const th of all("th[aria-sort]", table)) {
        const mine = find("button", th).dataset.key === key;
        th.setAttribute("aria-sort", mine ? (rising ? "ascending" : "descending") : "none");
      }
      order.value = key;
    }

    for (const th of all("th[aria-sort]", table)) {
      const button = find("button", th);
      button.addEventListener("click", () => {
        const now = th.getAttribute("aria-sort");
        const best = button.dataset.rising === "true";
        const rising = now === "none" ? best : now !== "ascending";
        sort(button.dataset.key, rising);
        status.textContent = `Sorted by ${button.textContent}, ${rising ? "ascending" : "descending"}`;
      });
    }
    order.addEventListener("change", () => {
      const button = find(`th button[data-key="${CSS.escape(order.value)}"]`, table);
      sort(order.value, button.dataset.rising === "true");
    });

    function filter() {
      const words = form.elements.text.value.toLowerCase().split(/\s+/).filter(Boolean);
      const kind = form.elements.kind.value;
      let shown = 0;
      for (const { element, data } of rows) {
        const fits = (!kind || data.kind === kind) && words.every((word) => data.find.includes(word));
        element.hidden = !fits;
        shown += fits;
      }
      find(".none").hidden = shown > 0;
      const total = `${rows.length} agent${rows.length === 1 ? "" : "s"}`;
      status.textContent = shown === rows.length ? total : `${shown} of ${total}`;
    }

    function pictures() {
      const span = spanOf(board.rows, board.optimum, form.elements.axis.value === "near");
      const { at, step } = ticks(...span, 2);
      for (const { element, data } of rows) {
        find(".picture", element).replaceChildren(scorePicture(data, span, board.optimum, at));
      }
      axis.replaceChildren(...at.map((v) => {
        const label = make("span", {}, text(v, digitsOf(step)));
        label.style.left = percent(v, span);
        return label;
      }));
    }

    form.addEventListener("submit", (event) => event.preventDefault());
    form.addEventListener("input", filter);
    for (const input of all("[name=axis]", form)) input.addEventListener("change", pictures);
    pictures();
    // When readers go back to the page, browsers fill in the earlier choices.
    filter();
  }

  // --- charts ----------------------------------------------------------------------------------------------

  const chosen = new Set();

  function startCharts() {
    const legend = find(".legend");
    if (!legend) return null;
    board.rows.slice(0, 5).forEach((_, i) => chosen.add(i));
    board.rows.forEach((row, i) => {
      const key = draw("svg", { viewBox: "-12 -8 24 16", "aria-hidden": "true" });
      key.append(draw("line", { x1: -12, x2: 12, y1: 0, y2: 0, class: "curve" }), mark(row.kind, 4));
      const name = make("bdi", {}, String(row.name));
      const state = { type: "button", "data-colour": i % COLOURS, "aria-pressed": chosen.has(i) };
      const chip = make("button", state, key, name);
      chip.addEventListener("click", () => {
        if (!chosen.delete(i)) chosen.add(i);
        chip.setAttribute("aria-pressed", String(chosen.has(i)));
        charts();
      });
      for (const [event, on] of [["pointerenter", 1], ["focus", 1], ["pointerleave", 0], ["blur", 0]]) {
        chip.addEventListener(event, () => {
          for (const line of all(`.charts [data-line="${i}"]`)) line.classList.toggle("strong", Boolean(on));
        });
      }
      legend.append(chip);
    });
    return charts;
  }

  function charts() {
    const profiles = board.rows.map((row, i) => ({ i, lines: row.profile.length ? [row.profile] : [] }));
    const taus = profiles.flatMap(({ lines }) => lines.flat()).map(([tau]) => tau);
    chart(find("#profile"), profiles, {
      label: "Performance profile",
      x: "τ, normalised score",
      y: "share above τ",
      spanX: taus.length ? [Math.max(-0.5, Math.min(...taus)), Math.min(1.2, Math.max(...taus))] : [0, 1],
      spanY: [0, 1],
      tell: (line) => `half of its episodes above ${text(line.find((p) => p[1] <= 0.5)?.[0], 2)}`,
    });
    const curves = board.rows.map((row, i) => {
      const seeds = row.curves.map(({ steps, scores }) => steps.map((x, j) => [x, scores[j]]));
      return { i, lines: seeds.length ? [meanOf(seeds)] : [], faint: seeds.length > 1 ? seeds : [] };
    });
    const points = curves.flatMap(({ lines }) => lines.flat()).filter((p) => isNumber(p[1]));
    const scores = points.map((p) => p[1]);
    chart(find("#curves"), curves, {
      label: "Learning curves",
      x: "environment steps",
      y: "score",
      spanX: [0, points.reduce((most, p) => Math.max(most, p[0]), 1)],
      spanY: [
        scores.reduce((least, score) => Math.min(least, Math.max(score, -0.5)), 0),
        scores.reduce((most, score) => Math.max(most, Math.min(score, 1.2)), 1),
      ],
      format: count,
      tell: (line) => `${text(line[line.length - 1][1], 2)} at the end`,
      empty: "No submission here states a learning curve.",
    });
  }

  /** The mean over seeds, at the first seed's steps, up to where the shortest one ends. */
  function meanOf(seeds) {
    const at = (line, x) => {
      const k = line.findIndex((p) => p[0] >= x);
      if (k < 0) return null;
      if (k === 0 || line[k][0] === x) return line[k][1];
      const [[ax, ay], [bx, by]] = [line[k - 1], line[k]];
      return mix(ay, by, (x - ax) / (bx - ax));
    };
    return seeds[0].map(([x]) => {
      const values = seeds.map((line) => at(line, x)).filter(isNumber);
      return [x, values.length === seeds.length ? values.reduce((a, b) => a + b) / values.length : null];
    }).filter((p) => isNumber(p[1]));
  }

  function chart(place, series, { label, x: nameX, y: nameY, spanX, spanY, format, tell, empty }) {
    const width = place.clientWidth;
    if (!width) return;
    if (!series.some(({ lines }) => lines.length)) {
      place.replaceChildren(make("p", { class: "note" }, empty ?? "Nothing was measured."));
      return;
    }
    const height = clamp(Math.round(0.62 * width), 220, 360);
    const box = { left: 40, right: width - 20, top: 22, bottom: height - 40 };
    const x = (v) => mix(box.left, box.right, (v - spanX[0]) / (spanX[1] - spanX[0]));
    const y = (v) => mix(box.bottom, box.top, (v - spanY[0]) / (spanY[1] - spanY[0]));
    const told = series.filter(({ i, lines }) => chosen.has(i) && lines.length);
    const words = told.map(({ i, lines }) => `${board.rows[i].name}, ${tell(lines[0])}`).join("; ");
    const name = `${label}: ${words || "all in grey"}`;
    const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": name });
    const across = ticks(...spanX, Math.max(2, Math.round(width / 110)));
    for (const v of across.at) {
      svg.append(draw("line", { x1: x(v), x2: x(v), y1: box.top, y2: box.bottom, class: "grid" }));
      const words = format ? format(v) : text(v, digitsOf(across.step));
      svg.append(draw("text", { x: x(v), y: box.bottom + 18, "text-anchor": "middle" }, words));
    }
    const up = ticks(...spanY, 4);
    for (const v of up.at) {
      svg.append(draw("line", { x1: box.left, x2: box.right, y1: y(v), y2: y(v), class: v === 0 ? "zero" : "grid" }));
      svg.append(draw("text", { x: box.left - 8, y: y(v) + 4, "text-anchor": "end" }, text(v, digitsOf(up.step))));
    }
    svg.append(draw("text", { x: box.right, y: height - 4, "text-anchor": "end" }, nameX));
    svg.append(draw("text", { x: 0, y: 12 }, nameY));
    const path = (line) => {
      let d = "";
      for (const [a, b] of line) {
        if (!isNumber(a) || !isNumber(b) || a < spanX[0] || a > spanX[1]) continue;
        d += `${d ? "L" : "M"}${x(a).toFixed(1)} ${clamp(y(b), box.top - 4, box.bottom + 4).toFixed(1)}`;
      }
      return d;
    };
    // Draw grey lines first, so that they lie below the others.
    const ordered = [...series].sort((a, b) => chosen.has(a.i) - chosen.has(b.i) || b.i - a.i);
    for (const { i, lines, faint = [] } of ordered) {
      const look = chosen.has(i) ? "chosen" : "other";
      const group = draw("g", { "data-line": i, "data-colour": i % COLOURS, class: look });
      if (i >= COLOURS) group.classList.add("dashed");
      for (const line of chosen.has(i) ? faint : []) group.append(draw("path", { d: path(line), class: "faint" }));
      for (const line of lines) group.append(draw("path", { d: path(line), class: "curve" }));
      svg.append(group);
    }
    const hint = draw("text", { x: box.right, y: 12, "text-anchor": "end", class: "hint" });
    svg.append(hint);
    svg.addEventListener("pointermove", (event) => {
      const at = svg.getBoundingClientRect();
      const [px, py] = [event.clientX - at.left, event.clientY - at.top];
      let best = null;
      for (const { i, lines } of series) {
        for (const line of lines) {
          for (const [a, b] of line) {
            const away = Math.abs(x(a) - px) + Math.abs(y(b) - py);
            if (isNumber(b) && away < 40 && !(away >= best?.away)) best = { i, away, a, b };
          }
        }
      }
      for (const group of all("g", svg)) group.classList.toggle("strong", Number(group.dataset.line) === best?.i);
      hint.textContent = best ? `${board.rows[best.i].name}: ${text(best.b)}` : "";
    });
    svg.addEventListener("pointerleave", () => {
      hint.textContent = "";
      for (const group of all("g", svg)) group.classList.remove("strong");
    });
    place.replaceChildren(svg);
  }

  // --- drive -----------------------------------------------------------------------------------------------

  /** The address from # on; some programs that pass on links write ~ and = as %7E and %3D. */
  function hash() {
    try {
      return decodeURIComponent(location.hash);
    } catch {
      return location.hash; // it will be refused
    }
  }

  /** Let people drive: the program is loaded when somebody asks for it, or opens the link of a drive. */
  function startDrive() {
    const root = find("#drive");
    if (!root) return null;
    const [begin, said] = [find(".begin", root), find(".status", root)];
    const tools = { make, all, text, symbol, writeList, cleared, paint, placed, apart, windowOf, posesAt, load, episodes, hash, calm, fuller: root.dataset.fuller };
    let driver = null;

    async function open(wanted) {
      if (driver) return;
      begin.disabled = true;
      said.textContent = "Loading …";
      try {
        const drive = await load(root.dataset.program);
        const lacking = drive.lacking();
        if (lacking.length) throw new Error(`This browser lacks what driving needs: ${lacking.join(", ")}.`);
        const code = await load(root.dataset.code);
        if (driver) return;
        said.textContent = "";
        driver = drive.open(find(".driver", root), board, code, tools);
        begin.hidden = true;
        if (wanted) find(".stage", root).focus({ preventScroll: true });
        find(wanted ? ".driver" : "h2", root).scrollIntoView();
      } catch (error) {
        // Errors of the program come from features that an old browser lacks.
        said.textContent = error.constructor === Error ? error.message : TOO_OLD;
        find(".driver", root).replaceChildren(begin);
        begin.disabled = false;
      }
    }

    const linked = () => {
      if (/^#(drive=|seed=)/.test(hash())) open(false);
    };
    begin.addEventListener("click", () => open(true));
    window.addEventListener("hashchange", linked);
    linked();
    return () => driver?.show();
  }

  // --- overview --------------------------------------------------------------------------------------------

  function strip(place, { rows, optimum }) {
    const span = spanOf(rows, optimum, false);
    const svg = draw("svg", { class: "bar", width: "100%", height: "100%", "aria-hidden": "true" });
    svg.append(draw("line", { x1: "0", x2: "100%", y1: "50%", y2: "50%", class: "grid" }));
    for (const v of [0, 0.5, 1]) {
      svg.append(draw("line", { x1: percent(v, span), x2: percent(v, span), y1: "15%", y2: "85%", class: "grid" }));
      if (v !== 0.5) svg.append(draw("text", { x: percent(v, span), y: "36", "text-anchor": "middle" }, String(v)));
    }
    for (const row of [...rows].reverse()) {
      if (!isNumber(row.score)) continue;
      const at = { x: percent(clamp(row.score, ...span), span), y: "50%", overflow: "visible" };
      svg.append(draw("svg", at, mark(row.kind, 4)));
    }
    place.append(svg);
  }

  // --- menu ------------------------------------------------------------------------------------------------

  /** Close the list of environments on Escape, and when the reader turns to something else. */
  function startMenu() {
    const [menu, pages] = [find(".menu"), find(".pages")];
    // On narrow screens the menu comes first: for the eye by site.css, for the keyboard by its place.
    const narrow = matchMedia("(max-width: 76.2344em)");
    const move = () => pages.parentNode[narrow.matches ? "prepend" : "append"](pages);
    narrow.addEventListener("change", move);
    move();
    const away = ({ target }) => {
      if (!menu.contains(target)) menu.open = false;
    };
    const current = () => all("[aria-current]", menu).find((link) => link.offsetParent);
    menu.addEventListener("toggle", () => current()?.scrollIntoView({ block: "nearest" }));
    document.addEventListener("pointerdown", away);
    document.addEventListener("focusin", away);
    document.addEventListener("keydown", ({ key }) => {
      if (key !== "Escape" || !menu.open) return;
      menu.open = false;
      find("summary", menu).focus();
    });
  }

  // --- start -----------------------------------------------------------------------------------------------

  // Old browsers show the page as it is without scripts.
  if (!Element.prototype.replaceChildren) return;
  window.lagEnvs = { put, load, placed, windowOf, apart };
  const data = JSON.parse(find("#data").textContent);
  document.documentElement.classList.add("js");
  startMenu();
  readColours();
  const redraw = [];
  if (Array.isArray(data)) {
    for (const place of all("[data-strip]")) strip(place, data[place.dataset.strip]);
    redraw.push(() => {
      for (const canvas of all("[data-poster]")) poster(canvas, data[canvas.dataset.poster]);
    });
  } else {
    board = data;
    startRanking();
    redraw.push(startPlayer(), startCharts(), startDrive(), () => {
      for (const canvas of all("[data-poster]")) poster(canvas, board);
    });
    startFilm();
  }
  // With each change of the page a browser copies all canvases, even those out of sight, unless it is told to skip them.
  const sight = new IntersectionObserver(
    (entries) => entries.forEach(({ target, isIntersecting }) => target.toggleAttribute("data-away", !isIntersecting)),
    { rootMargin: "100px" },
  );
  all("canvas").forEach((canvas) => sight.observe(canvas));
  const again = () => redraw.forEach((each) => each?.());
  again();
  let width = 0;
  new ResizeObserver(() => {
    if (document.body.clientWidth === width) return;
    width = document.body.clientWidth;
    requestAnimationFrame(again);
  }).observe(document.body);
  const recolour = () => {
    readColours();
    again();
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
  new MutationObserver(recolour).observe(document.documentElement, { attributeFilter: ["data-scheme"] });
})();
