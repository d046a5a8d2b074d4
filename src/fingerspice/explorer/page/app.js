// The explorer: a state, a request in flight, and what its answer shows.

import { Sliders, Waveforms, make, write } from "./controls.js";
import { Sets } from "./sets.js";
import { read } from "./recording.js";
import { Harmonics, Means, Traces } from "./plots.js";
import { Stack } from "./stack.js";
import { OWN, fromHash, ofExample, request, reset, toHash } from "./state.js";
import { Parts, quantity } from "./units.js";

const $ = (id) => document.getElementById(id);
let examples = [];
let state = null;
/** Sentences about names in the link that mean nothing. */
let unknownInLink = [];
/** Whether a request is in flight, and whether another one waits for it. */
let [inFlight, again] = [false, false];
/** Answers: the last one, the last one of a run that did not fail, and the one that is pinned. */
let [now, good, pinned] = [null, null, null];
/** Parts of the page, made at the start. */
let traces, harmonics, means, stack, sliders, waveforms, sets;
let sweep = { key: "", points: [], message: "", level: 0, left: [] };
/** Timers: of the means against frequency, of the sentence about an answer that takes long, of the address. */
let [idle, slow, address] = [0, 0, 0];
/** Counts the scenes chosen: an answer that comes after another choice belongs to none. */
let shown = 0;
let recording = null;
/** The address as it was last written. */
let written = "";

/** What a page without a server holds; null of a page with one. */
const bytes = $("baked") && Uint8Array.from(atob($("baked").textContent), (letter) => letter.charCodeAt(0));
const baked = bytes && (await new Parts(new Response(bytes)).next());

/** Ask for something: the parts of the answer, each by `next()`. */
async function ask(what, body) {
  if (baked) {
    const found = what === "scene" && state.deck === null ? baked.scenes[state.scene] : null;
    const answer = found || { ok: false, message: "this page has no program behind it: fingerspice explore has", sliders: [], traces: [] };
    return { next: async () => answer };
  }
  const response = await fetch(what, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  if (response.ok) return new Parts(response);
  throw new Error((await response.json()).message);
}

/** The request of now, with the recording where the source is one. */
function asking() {
  const asked = request(state, examples);
  return recording && /RECORDING/i.test(asked.source || "") ? { ...asked, recording } : asked;
}

/** Take a file that was chosen or dropped as the source. */
async function take(file) {
  try {
    recording = await read(file);
    set("source", `RECORDING(${recording.times ? 1 : 150})`);
  } catch (error) {
    say(error.message, true);
  }
}

/** Ask for the scene of now; while a request is in flight, only the latest state waits for it. */
async function refresh() {
  // The address follows a slider that moves at some distance, since browsers limit how often it changes.
  clearTimeout(address);
  address = setTimeout(keepAddress, 200);
  if (!slow) slow = setTimeout(() => say("computing; the first run of its kind compiles, which takes up to a minute"), 700);
  if (inFlight) {
    again = true;
    return;
  }
  inFlight = true;
  clearTimeout(idle);
  try {
    do {
      again = false;
      const of = shown;
      const parts = await ask("scene", asking());
      const answer = { t: new Float64Array(0), ...(await parts.next()) };
      clearTimeout(slow);
      slow = 0;
      // While a slider moves, an answer is shown although it has moved on since; one to another scene is not.
      if (of === shown) show(answer);
      Object.assign(answer, await parts.next());
      if (of === shown) showFigures(answer);
    } while (again);
  } catch (error) {
    say(`no answer from the program that opened this page: is it still running? (${error.message})`, true);
  } finally {
    clearTimeout(slow);
    slow = 0;
    inFlight = false;
    if (again) refresh();
  }
  idle = setTimeout(sweepMore, 400);
}

function say(text, failed = false) {
  $("status").textContent = text;
  $("status").className = failed ? "failed" : "";
}

/** Show the first part of an answer: traces, and what is said of them. */
function show(answer) {
  now = answer;
  if (answer.ok) good = answer;
  if (answer.ok || good || answer.t.length > 1) traces.show(answer, answer.ok ? null : good, pinned);
  else traces.clear();
  if (!answer.ok && !good) {
    // What is left on the page belongs to another scene.
    harmonics.show([]);
    stack.show({});
    means.clear();
    $("figures").replaceChildren();
    $("facts").textContent = "";
  }
  document.body.classList.toggle("before", !answer.ok && Boolean(good));
  const values = (of) => JSON.stringify([of.set, of.options.source]);
  const changed = values(state) !== values(reset(state, examples));
  say(answer.ok ? `${answer.title}${changed ? " (changed)" : ""}: ${answer.error.text}` : answer.message, !answer.ok);
  warn(answer);
  if (answer.sliders.length) sliders.update(answer.sliders, replacedSource(answer), state.set);
  controls();
  sets.show(answer);
  document.body.dataset.answers = Number(document.body.dataset.answers || 0) + 1;
}

function warn(answer) {
  const said = [...unknownInLink, ...(answer.unknown || []), ...(answer.warnings || [])];
  $("warnings").replaceChildren(...said.map((textContent) => make("li", { textContent })));
}

/** Show what comes after the traces: harmonics, the stack, figures and facts. */
function showFigures(answer) {
  if (baked) {
    // A page without a server shows the values, and cannot move them.
    const controls = "#controls input, #controls select, #controls textarea, #run, #deck, #python, #reset";
    for (const control of document.querySelectorAll(controls)) control.disabled = true;
  }
  if (answer.ok && answer.figures) {
    warn(answer);
    harmonics.show(answer.harmonics);
    stack.show(answer);
    table();
    $("facts").textContent = [
      `Model: ${answer.plan.tier} (${answer.plan.text}).`,
      `Charge law ${answer.charge_law}, area ${answer.area}, method ${answer.method}.`,
      `Run of ${quantity(answer.t_stop, "s")}${answer.period ? `, period ${quantity(answer.period, "s")}` : ""}.`,
    ].join("\n");
  } else if (answer.message) {
    say(answer.message, true);
    document.body.classList.add("before");
  }
  document.body.dataset.figures = Number(document.body.dataset.figures || 0) + 1;
}

/** The element whose waveform the page's text replaces. */
function replacedSource(answer) {
  const text = state.options.source || "";
  if (!text) return null;
  const named = /^\s*([\w.]+)\s*=/.exec(text);
  const sources = answer.sliders.filter((g) => g.device === "V" || g.device === "I");
  const found = named && sources.find((g) => g.element.toLowerCase() === named[1].toLowerCase());
  return found ? found.element : sources.length ? sources[0].element : null;
}

function table() {
  const old = new Map((pinned && pinned.figures ? pinned.figures : []).map((f) => [f.name, f]));
  const head = ["signal", "mean", "mean, last period", "smallest", "largest", ...(pinned ? ["pinned mean", "change"] : [])];
  const row = (tag, texts) => {
    const out = make("tr");
    for (const textContent of texts) make(tag, { textContent }, out);
    return out;
  };
  const rows = good.figures.map((f) => {
    const size = Math.max(Math.abs(f.max), Math.abs(f.min));
    // What is left of a mean after the rounding of large values is nought.
    const clean = (x) => (x !== null && Math.abs(x) < 1e-9 * size ? 0 : x);
    const figures = [f.mean, f.mean_periodic, f.min, f.max].map((x) => quantity(clean(x), f.unit, 5));
    const texts = [f.element ? `${f.label} ${f.element}` : f.label, ...figures];
    if (pinned) {
      const before = old.has(f.name) ? old.get(f.name).mean : null;
      // The mean of what goes to and fro is a small rest, whose change says nothing.
      const usable = before !== null && f.mean !== null && Math.abs(before) > 0.01 * size;
      texts.push(quantity(clean(before), f.unit, 5), usable ? `${(100 * (f.mean / before - 1)).toFixed(2)} %` : "–");
    }
    return row("td", texts);
  });
  $("figures").replaceChildren(row("th", head), ...rows);
}

/** Mean force against frequency: a few points at first, then those between them. */
async function sweepMore() {
  if (baked || inFlight || !now || !now.ok || !now.figures || !now.figures.some((f) => f.name.startsWith("f_el"))) return;
  const key = JSON.stringify(request(state, examples));
  if (sweep.key !== key) sweep = { key, points: [], message: "", level: 0, left: [] };
  if (sweep.message || (!sweep.left.length && sweep.level > 3)) {
    drawMeans();
    return;
  }
  if (!sweep.left.length) {
    const between = sweep.points.slice(1).map(([f], i) => Math.sqrt(f * sweep.points[i][0]));
    sweep.left = sweep.level === 0 ? [10, 100, 1e3, 1e4, 1e5] : between;
    sweep.level += 1;
  }
  // A few at a time, since a slider that moves has to wait for them.
  const frequencies = sweep.left.splice(0, 3);
  const mine = sweep;
  inFlight = true;
  try {
    const found = await (await ask("means", { ...asking(), frequencies })).next();
    if (found.ok) {
      mine.points.push(...Array.from(found.frequency, (f, i) => [f, found.force[i]]));
      mine.points.sort((a, b) => a[0] - b[0]);
      mine.amplitude = found.amplitude;
      // The mean force is that of the first finger.
      mine.finger = good && good.stacks.length > 1 ? found.gap : "";
    } else {
      mine.message = found.message;
    }
  } catch {
    mine.message = "no answer";
  } finally {
    inFlight = false;
  }
  if (again) {
    refresh();
    return;
  }
  drawMeans();
  if (!mine.message) idle = setTimeout(sweepMore, 0);
}

function drawMeans() {
  const figure = good && good.figures && good.figures.find((f) => f.signal === "f_el" || f.name.startsWith("f_el"));
  const force = figure ? figure.mean_periodic : null;
  const here = good && good.frequency && force !== null ? [good.frequency, force] : null;
  means.show(sweep.points, here, sweep.message, sweep.amplitude, sweep.finger);
}

function controls() {
  const option = (key) => state.options[key] || "";
  for (const select of ["charge_law", "area", "skin", "last", "rtol"].map($)) {
    const value = option(select.id);
    if (![...select.options].some((o) => o.value === value)) select.append(new Option(value, value));
    select.value = value;
  }
  write($("periods"), option("periods"));
  waveforms.update(option("source"), now.waveform);
  $("scene").value = state.deck === null ? state.scene : "";
  const example = examples.find((e) => e.name === state.scene);
  $("note").textContent = state.deck === null && example ? example.note : "";
  write($("netlist"), request(state, examples).deck);
}

function keepAddress() {
  const hash = toHash(state, examples);
  if (hash !== written) history.replaceState(null, "", hash);
  written = hash;
}

function set(key, value) {
  if (value === "") delete state.options[key];
  else state.options[key] = value;
  unknownInLink = [];
  refresh();
}

/** Take another waveform; values of the one before it go. */
function setSource(text) {
  const source = now ? replacedSource({ sliders: now.sliders }) : null;
  const replaced = source || (now && now.sliders.length ? now.sliders[0].element : null);
  for (const path of Object.keys(state.set)) if (replaced && path.startsWith(`${replaced}.`)) delete state.set[path];
  // The deck's own source may have been changed before the page was opened.
  const own = state.scene === OWN && state.deck === null && examples.find((e) => e.name === OWN).request.source;
  set("source", text || own || "");
}

/** Apply a named set of parameters, `entry`: its values become those of the page. */
async function apply(entry) {
  const of = shown;
  const answer = await (await ask("set", { ...asking(), apply: entry })).next();
  if (of !== shown) return;
  if (!answer.ok) {
    say(answer.message, true);
    return;
  }
  const before = (state.options.sets || "").split(",").filter((one) => one && one !== answer.set);
  state.options.sets = [...before, answer.set].join(",");
  Object.assign(state.set, answer.overrides);
  if (answer.source === null) refresh();
  else setSource(answer.source);
}

function open(hash) {
  written = "";
  choose(...fromHash(hash, examples));
}

/** Ask for another scene. */
function choose(next, unknown = []) {
  state = next;
  unknownInLink = unknown;
  good = null;
  shown += 1;
  means.clear();
  refresh();
}

function save(name, blob) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function csv() {
  if (!good) return;
  const head = ["t (s)", ...good.traces.map((x) => `${x.name} (${x.unit})`)];
  const lines = Array.from(good.t, (t, i) => [t, ...good.traces.map((x) => x.values[i])].join(","));
  save("fingerspice.csv", new Blob([[head.join(","), ...lines, ""].join("\n")], { type: "text/csv" }));
}

async function copied(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    say(`${what} copied`);
  } catch {
    // A browser may refuse the clipboard: then the text is given as a file.
    save("fingerspice.txt", new Blob([text], { type: "text/plain" }));
  }
}

function share() {
  const own = state.scene === OWN && state.deck === null ? examples.find((e) => e.name === OWN) : null;
  const without = own && own.unsaid.length ? `, without ${own.unsaid.join(", ")}, which was changed before this page was opened,` : "";
  copied(location.href.replace(/#.*$/, "") + toHash(state, examples), `link${without}`);
}

async function text(what, use) {
  const answer = await (await ask(what, asking())).next();
  if (answer.ok) use(answer.text);
  else say(answer.message, true);
}

function listen() {
  $("scene").addEventListener("change", () => choose(ofExample(examples.find((e) => e.name === $("scene").value))));
  for (const id of ["charge_law", "area", "skin", "last", "rtol", "periods"]) {
    $(id).addEventListener("change", () => set(id, $(id).value.trim()));
  }
  $("pin").addEventListener("click", () => {
    pinned = pinned ? null : good;
    $("pin").textContent = pinned ? "Unpin" : "Pin";
    $("pin").setAttribute("aria-pressed", String(Boolean(pinned)));
    if (now && (now.ok || good)) {
      show(now);
      showFigures(now);
    }
  });
  $("reset").addEventListener("click", () => choose(reset(state, examples)));
  $("share").addEventListener("click", share);
  $("deck").addEventListener("click", () => text("deck", (x) => save("fingerspice.cir", new Blob([x], { type: "text/plain" }))));
  $("python").addEventListener("click", () => text("python", (x) => copied(x, "Python")));
  $("csv").addEventListener("click", csv);
  $("png").addEventListener("click", () => traces.picture().toBlob((blob) => save("fingerspice.png", blob)));
  $("run").addEventListener("click", () => choose({ ...state, deck: $("netlist").value, set: {}, options: { last: "2" } }));
  $("file").addEventListener("change", () => $("file").files.length && take($("file").files[0]));
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dropping");
  });
  addEventListener("dragleave", () => document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (event.dataTransfer.files.length) take(event.dataTransfer.files[0]);
  });
  $("link").addEventListener("change", () => open($("link").value));
  addEventListener("hashchange", () => {
    if (location.hash !== written) open(location.hash);
  });
}

async function start() {
  const first = baked ? baked.start : await (await fetch("start")).json();
  examples = first.examples;
  if (first.own) examples.unshift({ name: OWN, note: "The circuit for which this page was opened.", ...first.own });
  $("scene").append(...examples.map((e) => new Option(e.title, e.name)), Object.assign(new Option("(another netlist)", ""), { hidden: true }));
  traces = new Traces($("plots"));
  harmonics = new Harmonics($("harmonics"));
  stack = new Stack($("stack"), (at) => traces.point(at));
  means = new Means($("means"));
  const wrong = (sentence) => say(sentence, true);
  sliders = new Sliders($("sliders"), (path, value) => {
    state.set[path] = value;
    unknownInLink = [];
    refresh();
  }, wrong);
  waveforms = new Waveforms(first.waveforms, setSource, wrong);
  sets = new Sets(first.sets, apply);
  listen();
  if (location.hash.length > 1) open(location.hash);
  else choose(ofExample(examples[0]));
}

start().catch((error) => say(`the page could not start: ${error.message}`, true));
