/* Driving an environment in the page: the player's input, and the stage.
 *
 * Loaded on demand, in one function with episode.js.
 */
// --- the player's input ----------------------------------------------------------------------------------

const PAIRS = [["ArrowLeft", "ArrowRight"], ["ArrowDown", "ArrowUp"], ["a", "d"], ["s", "w"]];
const NAMES = { ArrowLeft: "←", ArrowRight: "→", ArrowDown: "↓", ArrowUp: "↑" };
const SPOKEN = { ArrowLeft: "left arrow", ArrowRight: "right arrow", ArrowDown: "down arrow", ArrowUp: "up arrow" };
const nameOf = (key) => NAMES[key] ?? key.toUpperCase();
/** Keys that act as arrow keys while they control nothing themselves. */
const ALIASES = { a: "ArrowLeft", d: "ArrowRight", s: "ArrowDown", w: "ArrowUp" };

/** Where an event's key is on the keyboard; keys on a screen have no place. */
const placeOf = ({ code, key }) => code || key.toLowerCase();

/** Keys, pointer and gamepad as numbers per control. */
class Hands {
  constructor(about, lost) {
    [this.about, this.lost] = [about, lost];
    /** Keys by their place on the keyboard: what a key is called may change while it is held, as with Shift. */
    this.pressed = new Map();
    [this.pointer, this.finger] = [null, null];
    this.pad = null;
    this.held = {};
  }

  get pairs() {
    return PAIRS.slice(0, this.about.controls.length);
  }

  /** The name of an event's key. */
  keyOf({ key }) {
    const small = key.length === 1 ? key.toLowerCase() : key;
    return this.pairs.flat().includes(small) ? small : ALIASES[small] ?? small;
  }

  press(event) {
    const place = placeOf(event);
    if (this.pressed.get(place)?.held) return;
    this.pressed.set(place, { key: this.keyOf(event), held: true, read: false });
  }

  /** While somebody drives, a key that is released before a step has read it still acts on the next step. */
  lift(event, driving) {
    const pressed = this.pressed.get(placeOf(event));
    if (!pressed) return;
    pressed.held = false;
    if (pressed.read || !driving) this.pressed.delete(placeOf(event));
  }

  /** Whether a key acts. */
  presses(key) {
    return [...this.pressed.values()].some((pressed) => pressed.key === key);
  }

  /** The numbers for a step. */
  read() {
    const numbers = this.numbers();
    for (const [place, pressed] of this.pressed) {
      pressed.read = true;
      if (!pressed.held) this.pressed.delete(place);
    }
    return numbers;
  }

  /** Whether nobody drives: no key, pointer or stick is held. */
  get idle() {
    return !this.pressed.size && !this.pointer && this.readPad() === null;
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
      const [down, up] = (PAIRS[i] ?? []).map((key) => this.presses(key));
      const digit = many ? values.findIndex((_, j) => this.presses(String(j + 1))) : -1;
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

/** What driving needs and old browsers lack. */
const LACKING = [
  ["64-bit integers (BigInt)", typeof BigInt === "function"],
  ["drawing (canvas)", typeof CanvasRenderingContext2D === "function"],
  ["animation (requestAnimationFrame)", typeof requestAnimationFrame === "function"],
];
const lacking = () => LACKING.filter(([, there]) => !there).map(([what]) => what);

/** A value whose numbers are changed by those of other values of the same shape: a + Σ (b - a). */
function changed(base, others) {
  if (typeof base === "number") return others.reduce((sum, other) => sum + other - base, base);
  if (!Array.isArray(base)) return base;
  if (others.some((other) => other.length !== base.length)) return others[others.length - 1];
  return base.map((part, i) => changed(part, others.map((other) => other[i])));
}

/** Numbers between two values of the same shape. */
function scaled(a, b, share) {
  if (typeof a === "number") return a + (b - a) * share;
  if (!Array.isArray(a)) return a;
  return a.length === b.length ? a.map((part, i) => scaled(part, b[i], share)) : share < 0.5 ? a : b;
}

/** Build the driver into an element and return it. */
function open(root, board, code, tools) {
  const { make, all, text, symbol, writeList, cleared, paint, placed, apart, windowOf, posesAt, load, hash, calm } = tools;
  const { about } = code;
  const known = board.known && board.known.best !== board.known.random ? board.known : null;
  /** Before an episode's end, a random policy's return counts in proportion to the time that has passed. */
  const scoreOf = (episode) => {
    const passed = finished(episode) ? 1 : episode.steps / (about.limit ?? Infinity);
    return (episode.total - known.random * passed) / (known.best - known.random);
  };

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
  const spoken = make("dl");
  const values = make("canvas", { class: "values" }, spoken);
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
  // Browsers that follow this hint show a key's effect sooner, and skip work of their compositor.
  for (const painted of [canvas, values]) painted.getContext("2d", { desynchronized: true });
  root.replaceChildren(verdict, stage, bar, make("div", { class: "numbers" }, readout, values), share, panel, said);
  copy.disabled = watch.hidden = episodeLabel.hidden = true;

  const hands = new Hands(about, () => {
    if (running) pause();
    tell("The gamepad is disconnected. Drive with the keys, or connect it again; Space continues.");
  });
  const short = (x) => text(x, Number.isInteger(x) ? 0 : 2);
  const valueOf = ({ unit }, x) => `${short(x)} ${unit}`.trim();
  const lists = about.controls.filter(({ values }) => values.length);
  const digits = Math.min(Math.max(...lists.map(({ values }) => values.length)), 9);
  const listed = lists.length > 1 ? `, or 1 to ${digits} for the action with that number in each list`
    : lists.map((one) => `, or ${one.values.slice(0, digits).map((x, i) => `${i + 1} for ${valueOf(one, x)}`).join(", ")}`).join("");
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
  const touched = matchMedia("(hover: none)").matches;
  // Without a key, the first listed action is taken, which may push too.
  const unasked = about.controls
    .map((control, i) => [control, control.values[about.rest[i]]])
    .map(([control, x]) => (x ? ` Without a ${touched ? "touch" : "key"}, ${symbol(control.name)} is ${valueOf(control, x)}.` : ""))
    .join("");
  /** Whether time waits for the first input: the action without any input would end some episodes at once. */
  const waiting = () => Boolean(unasked && !rerunning && !me.steps && hands.idle);
  const nothing = board.picture && about.frames ? "" : " This scene has nothing to draw; the numbers show how it moves.";
  /** What a finger on the picture does. */
  const touching = about.controls.slice(0, 2)
    .map((control, i) => {
      const [less, more] = [["left", "right"], ["down", "up"]][i];
      const what = [control.meaning, letter(control)].filter(Boolean).join(" ");
      if (!control.values.length) return `${less} and ${more} for ${what}`;
      return `${less} for ${valueOf(control, control.values[0])}, ${more} for ${valueOf(control, control.values[control.values.length - 1])} of ${what}`;
    })
    .join("; ") + (about.controls.every(({ values }) => values.length) ? "" : ". The farther from the middle, the stronger");
  const starting = (keys) => {
    const by = touched ? `A tap starts. Then hold a finger on the picture: ${touching}.`
      : `${keys}; or hold the mouse button on the picture, or use a gamepad. Space or a click starts.`;
    return `${keys ? by : "There is nothing to control here: just watch. Space or a tap starts."}${unasked}${nothing}`;
  };
  stage.setAttribute("aria-label", `Drive ${board.id}. ${heard || "There is nothing to control"}. Space starts and pauses, R restarts, N draws another start.`);

  let [machine, constants] = [code, code.constants];
  let [fuller, fetching] = [null, false];
  const anySeed = () => big(Math.floor(Math.random() * 2 ** 32));
  let seed = anySeed();
  let me = new Episode(machine, seed, constants);
  let mine = [];
  let ghost = null;
  let linked = null;
  let rerunning = null;
  let [running, turn, beat] = [false, 0, 0];
  let tapped = null;
  let [before, left, shownAt] = [0, 0, 0];
  let places = null;
  let [past, now] = [me.poses(), me.poses()];
  const [between, ghostly] = [roomOf(about), roomOf(about)];
  let picture = board.picture;
  const untouched = () => constants === code.constants;
  const finished = (episode) => episode.over === "terminated" || episode.over === "truncated";
  const ended = () => Boolean(me.over || (rerunning && !rerunning.keys[me.steps]));

  /** A return, and its score if the episode is whole. */
  const resultOf = (episode) => `return ${text(episode.total, 2)}${known && finished(episode) ? `, score ${text(scoreOf(episode))}` : ""}`;

  /** Writes to the page and to screen readers: `tell` does them at once, `inTurn` each in a frame of its own. */
  const telling = (words, spoken = words) => [() => (message.textContent = words), () => (said.textContent = spoken)];
  const tell = (...words) => telling(...words).forEach((write) => write());

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

  /** Whether the chosen ghost or machine is still loading; until it is there, nothing starts, because it restarts the drive. */
  const loading = () => fetching || Boolean(ghostSelect.value && !ghost);

  async function chooseGhost() {
    const asked = ghostSelect.value;
    const [kind, row] = asked.split(":");
    if (running) pause();
    episodeLabel.hidden = true;
    ghost = null;
    if (kind) {
      label();
      tell("Loading the ghost …");
      const found = await GHOSTS[kind](Number(row)).catch(() => null);
      if (ghostSelect.value !== asked) return;
      if (!found) {
        dismissGhost();
        label();
        tell("The ghost could not be loaded. Choose it again when you are online.");
        return;
      }
      ghost = found;
      if (ghost.replays) {
        episodeSelect.replaceChildren(...ghost.replays.map((replay, i) => option(String(i), seeded(replay))));
        episodeLabel.hidden = false;
        chooseEpisode();
        return;
      }
      if (ghost.seed !== undefined) seed = ghost.seed;
    }
    beginAnew();
    if (ghost?.act) warmUp();
  }

  function chooseEpisode() {
    ghost.replay = ghost.replays[Number(episodeSelect.value)] ?? ghost.replays[0];
    const start = ghost.replay.reset_seed;
    if (start !== undefined) seed = big(start);
    beginAnew();
    if (start === undefined) tell("The seed of this episode is not known, so the ghost starts elsewhere.", starting(heard));
  }

  function startGhost() {
    if (!ghost?.act) return;
    ghost.episode = new Episode(machine, seed, constants);
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
    const address = `#seed=${seed}`;
    if (seed !== linked?.seed && location.hash !== address) history.replaceState(null, "", address);
  }

  /** Go back to the start, which is not shown yet. */
  function rewind() {
    if (!running) turn += 1;
    me = new Episode(machine, seed, constants);
    mine = [];
    [past, now] = [me.poses(), me.poses()];
    left = 0;
    startGhost();
  }

  function restart() {
    rewind();
    setLink("");
    if (running) note();
    label();
    show(1);
  }

  /** Stop, go back to the start, and let the player begin. */
  function beginAnew() {
    running = false;
    rerunning = null;
    hands.release();
    restart();
    tell(starting(how), starting(heard));
  }

  /**
   * Play a trial episode in the browser's idle time. A browser runs new code slowly at first, up to a hundred times
   * slower, and compiles what it has run often. So a drive begins at full speed.
   */
  function warmUp() {
    const [trial, act, room] = [new Episode(machine, seed, constants), ghost?.act ?? (() => about.rest), roomOf(about)];
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
    const key = rerunning ? rerunning.keys[me.steps] : hands.read();
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

  /** Do things in frames of their own, because each of them lays out the page anew; until others are to be done. */
  function inTurn(...things) {
    turn += 1;
    const now = turn;
    const next = (time) => {
      if (turn !== now) return;
      things.shift()(time);
      if (things.length) requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  }

  /** Stop. */
  function close(words = "") {
    running = false;
    const told = entries(ghostAt(1));
    inTurn(
      () => writeList(readout, told), // not visible yet
      markStage,
      () => readOut(told),
      nameButtons,
      showAgain,
      ...telling(ending(words)),
      () => idly(offer),
    );
  }

  /** What to say at the end of a drive. */
  function ending(words) {
    const over = words || { terminated: "The episode has ended", truncated: "Time is up", refused: "The next step was refused, because it cannot be computed to full accuracy" }[me.over];
    const result = untouched() ? resultOf(me) : `return ${text(me.total, 2)}, not scored`;
    const beside = ghost && ghostAt(1) ? `; ${ghost.name}: return ${text(ghostAt(1).total, 2)} by then` : "";
    const next = touched ? "Restart repeats this start; New start draws another."
      : `Press R to ${rerunning ? "drive from this start" : "try again"}, N for another start.`;
    return `${over}: ${result}${beside}. ${next}`;
  }

  /** Writes to the link's field and its button, like `telling`. */
  const linking = (value) => [() => (link.value = value), () => (copy.disabled = !value)];
  const setLink = (value) => linking(value).forEach((write) => write());

  /** Say where the link will be what will stand there. */
  function invite() {
    link.placeholder = untouched() ? "Your drive's link, once it stops" : "Drives of a changed machine have no link";
  }

  /** Offer the link of this drive. */
  function offer() {
    const whole = !running && untouched() && mine.length && !rerunning;
    setLink(whole ? writeLink(about, seed, mine, me.total, location.href.replace(/#.*/, "")) : "");
  }

  function frame(time) {
    if (!running) return;
    if (waiting()) {
      before = time;
      beat = requestAnimationFrame(frame);
      return;
    }
    if (!me.steps && !rerunning) message.textContent = "";
    left += Math.min(Math.max(time - before, 0), 100) / 1000 * Number(speed.value);
    before = time;
    // If the steps of a frame take too long, time runs slower instead of in jerks.
    const end = performance.now() + 3;
    while (running && left >= about.dt) {
      left -= about.dt;
      tick();
      if (performance.now() > end) break;
    }
    if (left > about.dt) left = about.dt;
    if (!running) {
      draw(1);
      return;
    }
    show(left / about.dt);
    beat = requestAnimationFrame(frame);
  }

  /** Mark the stage while somebody drives. */
  function markStage() {
    stage.toggleAttribute("data-driving", running);
    readout.setAttribute("aria-hidden", running); // `spoken` replaces it
    spoken.setAttribute("aria-hidden", !running);
  }

  function nameButtons() {
    for (const starts of [go, again, fresh]) starts.disabled = loading();
    go.textContent = running ? "Pause" : ended() ? "Restart" : me.steps ? "Resume" : "Start";
  }

  /** Show the button that restarts, unless `go` does that. It keeps its place, so that nothing else moves. */
  function showAgain() {
    again.style.visibility = ended() ? "hidden" : "";
  }

  function label() {
    markStage();
    nameButtons();
    showAgain();
  }

  function run() {
    if (running || loading()) return;
    running = true;
    tapped = null;
    shownAt = 0;
    note();
    const words = rerunning ? "Watching the link's drive: you do not steer. Space pauses, R lets you drive."
      : waiting() ? `Time begins with your first ${touched ? "touch" : "key"}.` : "";
    cancelAnimationFrame(beat); // of a drive that was stopped within this frame
    inTurn(...telling(words, words || "Driving"), nameButtons, showAgain, ...linking(""), markStage, (time) => {
      before = time;
      beat = requestAnimationFrame(frame);
    });
  }

  /** Drive from the start. */
  function begin() {
    if (running || loading()) {
      restart();
      return;
    }
    rewind();
    run();
  }

  /** Pause or go on. An episode that has ended starts again, with the player at the controls. */
  function toggle() {
    if (running) {
      pause();
      return;
    }
    if (!ended()) {
      run();
      return;
    }
    rerunning = null;
    begin();
  }

  function pause() {
    running = false;
    turn += 1;
    hands.release();
    show(1); // first, as it asks for the canvas's size
    label();
    tell(`Paused at ${text(me.steps * about.dt, 2)} seconds.`);
    offer();
  }

  // --- display

  function show(part) {
    draw(part);
    // Numbers that change sixty times a second cannot be read, and cost more than the step.
    const moment = performance.now();
    if (running && moment - shownAt < 120) return;
    shownAt = moment;
    readOut(entries(ghostAt(part)));
  }

  function draw(part) {
    const { pen, width, height } = cleared(canvas);
    if (width && picture && about.frames) {
      const box = { x: 8, y: 8, width: width - 16, height: height - 16 };
      const poses = mixedPoses(past, now, part, between);
      const seenFrom = windowOf(picture, poses);
      paint(pen, box, seenFrom, placed(picture, poses, seenFrom));
      const beside = ghostAt(part);
      if (beside) {
        pen.globalAlpha = 0.35;
        const its = ghost.act ? picture : board.picture; // a recording is of the unchanged machine
        paint(pen, box, seenFrom, placed(apart(its, beside.poses, poses), beside.poses, seenFrom));
        pen.globalAlpha = 1;
      }
    }
  }

  /** Write the numbers. While they change they are painted, because laying out text takes a browser milliseconds. */
  function readOut(told) {
    const { pen, width } = cleared(values);
    if (!running || readout.children.length !== told.length) {
      writeList(readout, told);
      places = null;
    }
    if (running && width) {
      places ??= placesOf(readout);
      [pen.font, pen.fillStyle, pen.textBaseline] = [places.font, places.colour, "middle"];
      told.forEach(([, value], i) => pen.fillText(value, ...places.at[i]));
    }
    writeList(spoken, told); // within the canvas, for those who do not see it
  }

  /** Where the numbers of a list stand and how they look: asked seldom, as the browser may have to lay out the page. */
  function placesOf({ children }) {
    const cells = [...children].map((row) => row.lastChild);
    const { fontSize, fontFamily, color } = getComputedStyle(cells[0]);
    const at = cells.map(({ offsetLeft, offsetTop, offsetHeight }) => [offsetLeft, offsetTop + offsetHeight / 2]);
    return { font: `${fontSize} ${fontFamily}`, colour: color, at };
  }

  /** The names and values of the read-out. */
  function entries(beside) {
    const score = known && (finished(me) ? text(scoreOf(me)) : !ended() && `${text(scoreOf(me))} so far`) || "–";
    return [
      ["Time", `${text(me.steps * about.dt, 2)} s`],
      ["Return", text(me.total, 2)],
      ...(ghost ? [["Ghost's return", beside ? text(beside.total, 2) : "–"]] : []),
      ["Score", untouched() ? score : "not scored"],
      ...about.controls.map(({ name, unit, low, high, row }) => {
        const digits = Math.max(-low, high) < 1 ? 3 : 2;
        return [symbol(name), me.steps ? `${text(me.f[row], digits)} ${unit}`.trim() : "–"];
      }),
      ...board.state_names.map((name, i) => [symbol(name), `${text(me.f[i], 2)} ${board.state_units[i] ?? ""}`]),
    ];
  }

  // --- sliders

  function look() {
    if (!board.picture) return null;
    const others = inputs.filter(({ slider }) => slider.looks).map(({ slider: { looks }, input: { value, min, max } }) => {
      const place = ((value - min) / (max - min)) * (looks.length - 1);
      const first = Math.min(Math.floor(place), looks.length - 2);
      return scaled([looks[first].shapes, looks[first].window], [looks[first + 1].shapes, looks[first + 1].window], place - first);
    });
    const { shapes, window: box } = board.picture;
    const [all, wide] = others.length && !untouched() ? changed([shapes, box], others) : [shapes, box];
    return { ...board.picture, shapes: all, window: wide };
  }

  const inputs = about.sliders.map((slider) => {
    const input = make("input", { type: "range", min: slider.most ? "0" : "-1", max: "1", step: "0.01", value: "0" });
    const output = make("output");
    const name = slider.name.replace(/^com_/, "centre-of-mass ").replace(/_/g, " ");
    const say = () => {
      const value = slider.most ? slider.most * Number(input.value) : slider.value * 2 ** Number(input.value);
      output.textContent = `${+(value * (slider.shown ?? 1)).toPrecision(3)} ${slider.unit}`.trim();
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

  /** Parameters that are 0 in the environment and are not now: its own step lacks their terms. */
  const added = () => inputs.filter(({ slider, input }) => slider.most && Number(input.value));

  /** Apply the sliders' values and all that follows from them, and start over. */
  function change() {
    const values = inputs.map(({ say }) => say());
    if (added().length && !fuller) {
      fetchFuller();
      return;
    }
    const last = machine;
    [machine, constants] = [added().length ? fuller : code, code.constants];
    if (inputs.some(({ input }) => Number(input.value) !== 0)) {
      constants = Float64Array.from(code.constants);
      inputs.forEach(({ slider }, i) => (constants[slider.at] = values[i]));
      machine.functions.derive(constants);
    }
    picture = look();
    invite();
    restart();
    if (machine !== last) warmUp();
    const usual = ghost?.replays ? " The recorded ghost drives the unchanged one." : "";
    tell(untouched() ? "The machine is as it was: drives are scored again." : `The machine was changed: this drive is not scored.${usual}`);
  }

  /** Load the step with the terms of all parameters, and apply the sliders then. */
  async function fetchFuller() {
    if (fetching) return;
    if (running) pause();
    fetching = true;
    label();
    tell("Loading the changed machine …");
    const found = await load(tools.fuller).catch(() => null);
    fetching = false;
    fuller = found && { ...code, ...found };
    const wanted = added();
    if (!fuller) for (const { input } of wanted) input.value = "0";
    if (wanted.length) change();
    label();
    if (!fuller) tell("The changed machine could not be loaded. Move the slider again when you are online.");
  }

  const reset = button("reset", "Reset");
  reset.addEventListener("click", () => {
    for (const { input } of inputs) input.value = "0";
    change();
  });
  panel.append(reset);
  panel.hidden = !inputs.length;

  // --- links

  /** Recompute a link's drive, a little in each frame, and report whether its claim is true. */
  function checkLink(address) {
    if (rerunning) beginAnew();
    else if (running) pause();
    linked = null;
    watch.hidden = true;
    if (ghostSelect.value.startsWith("link:")) dismissGhost();
    listGhosts();
    let told;
    try {
      told = readLink(address, about);
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
        beginAnew();
      }
    };
    go();
  }

  function followHash() {
    const address = hash();
    verdict.textContent = "";
    delete verdict.dataset.true;
    if (address.includes(MARK)) {
      stage.focus();
      checkLink(address);
      return;
    }
    if (!address.startsWith("#seed=")) return;
    const number = /^#seed=(\d+)$/.exec(address)?.[1];
    const valid = number && !(big(number) >> big(BITS));
    if (!valid) {
      verdict.textContent = "The seed must be a whole number from 0 to 2⁶⁴ − 1; this start is a random one.";
      verdict.dataset.true = "false";
    }
    stage.focus();
    moveTo(valid ? big(number) : anySeed());
    beginAnew();
  }

  // --- what people do

  const still = (event) => event.ctrlKey || event.altKey || event.metaKey;

  const acts = { " ": toggle, r: afresh, n: another };
  stage.addEventListener("keydown", (event) => {
    if (still(event) || event.target !== stage) return;
    const key = hands.keyOf(event);
    const drives = hands.pairs.flat().includes(key) || (/^[1-9]$/.test(key) && about.controls.some((c) => c.values.length));
    if (drives) {
      hands.press(event);
      if (!running && !ended() && !event.repeat) run();
    } else if (key in acts) {
      if (!event.repeat) acts[key]();
    } else if (!running || !key.startsWith("Arrow")) return; // while somebody drives, arrows do not scroll the page
    event.preventDefault();
  });
  stage.addEventListener("keyup", (event) => hands.lift(event, running && !rerunning));
  stage.addEventListener("blur", () => hands.release());

  function afresh() {
    rerunning = null;
    begin();
  }

  /** Choose another start; a ghost that belongs to one start leaves. */
  function moveTo(start) {
    if (ghost?.replays || ghost?.seed !== undefined) dismissGhost();
    seed = start;
  }

  function another() {
    moveTo(anySeed());
    afresh();
  }

  function point(event) {
    const box = canvas.getBoundingClientRect();
    const across = (event.clientX - box.left - box.width / 2) / (0.42 * box.width);
    const up = (box.top + box.height / 2 - event.clientY) / (0.42 * box.height);
    hands.pointer = [clamp(across, -1, 1), clamp(up, -1, 1)];
  }

  // A finger at rest on the picture scrolls the page, unless it taps; while somebody drives, it steers.
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
    begin();
    stage.focus({ preventScroll: true });
  });
  // After a choice by pointer the keys drive again; those who choose by keys stay where they are.
  for (const select of [speed, ghostSelect, episodeSelect]) {
    let pointed = false;
    select.addEventListener("pointerdown", () => (pointed = true));
    select.addEventListener("keydown", () => (pointed = false));
    select.addEventListener("change", () => pointed && stage.focus({ preventScroll: true }));
  }
  speed.addEventListener("change", () => (before = performance.now()));
  ghostSelect.addEventListener("change", chooseGhost);
  episodeSelect.addEventListener("change", chooseEpisode);
  link.addEventListener("focus", () => link.select());
  copy.addEventListener("click", async () => {
    link.select();
    try {
      await navigator.clipboard.writeText(link.value);
      said.textContent = "The link was copied.";
      copy.textContent = "Copied";
      setTimeout(() => (copy.textContent = "Copy link"), 2000);
    } catch {
      // Pages opened from disk may not use the clipboard; the selected link can be copied by hand.
      tell("Copy the selected link.");
    }
  });
  window.addEventListener("hashchange", followHash);

  listGhosts();
  invite();
  restart();
  warmUp();
  tell(starting(how), starting(heard));
  if (calm.matches) speed.value = "0.5";
  const there = [...(navigator.getGamepads?.() ?? [])].find((pad) => pad?.connected);
  if (there) take(there);
  followHash();
  const redraw = () => {
    places = null; // the page's size or colours have changed
    show(1);
  };
  return { show: redraw, get episode() { return me; } };
}

window.lagEnvs.put({ Episode, agentOf, hexOf, lacking, open });
