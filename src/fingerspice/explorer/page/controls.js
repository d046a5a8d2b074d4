// Sliders: a label, a range, a text field in SPICE's notation, and the unit.

import { parse, spice } from "./units.js";

const STEPS = 1000;
const UNITS = { ohm: "Ω", "ohm m": "Ω m", "mm^2": "mm²", "mm^2/N^m": "mm²/Nᵐ", "mm^(2-n)": "mm²⁻ⁿ", "mm^4/N^2": "mm⁴/N²", deg: "°" };
let count = 0;

/** Place on the range, 0 to STEPS, of a value. */
function place(value, s) {
  if (!Number.isFinite(value)) return STEPS;
  const share = s.log ? Math.log(value / s.low) / Math.log(s.high / s.low) : (value - s.low) / (s.high - s.low);
  return Math.round(STEPS * Math.min(Math.max(share, 0), 1));
}

/** Value at a place, to three digits or as fine as the range needs. */
function at(position, s) {
  const share = position / STEPS;
  const value = s.log ? s.low * (s.high / s.low) ** share : s.low + share * (s.high - s.low);
  if (Math.abs(value) < 1e-9 * Math.max(Math.abs(s.low), Math.abs(s.high)) && !s.log) return 0;
  return Number(value.toPrecision(4));
}

/** A new element of the page. */
export function make(tag, properties = {}, parent = null) {
  const element = Object.assign(document.createElement(tag), properties);
  if (parent) parent.append(element);
  return element;
}

/** Write a text into a field, but not over what is being typed: then only a text that has changed is written. */
export function write(field, text) {
  if (document.activeElement !== field || field.dataset.text !== text) field.value = text;
  field.dataset.text = text;
}

/** One slider; `changed(text)` is called with the new value as text, `wrong(sentence)` where a typed one is no number. */
export function slider(s, name, changed, wrong) {
  const row = make("div", { className: "slider" });
  const id = `slider${(count += 1)}`;
  const label = make("label", { htmlFor: id, title: s.meaning ? `${name}: ${s.meaning}` : name }, row);
  label.append(...(s.meaning ? [`${s.meaning} `, make("code", { textContent: s.name })] : [s.name]));
  const range = make("input", { type: "range", id, min: 0, max: STEPS, step: 1 }, row);
  const field = make("input", { type: "text", autocomplete: "off", spellcheck: false }, row);
  field.setAttribute("aria-label", `${name}, typed`);
  range.dataset.path = name;
  field.dataset.path = name;
  make("span", { className: "unit", textContent: UNITS[s.unit] || s.unit }, row);
  const show = (value) => {
    if (document.activeElement !== range) range.value = place(value, s);
    write(field, spice(value, s.unit, 6));
    range.setAttribute("aria-valuetext", `${spice(value, s.unit)} ${s.unit}`);
    field.classList.remove("invalid");
  };
  range.addEventListener("input", () => {
    const text = spice(at(Number(range.value), s), s.unit, 6);
    field.value = text;
    range.setAttribute("aria-valuetext", `${text} ${s.unit}`);
    changed(text);
  });
  field.addEventListener("change", () => {
    const value = parse(field.value);
    field.classList.toggle("invalid", value === null);
    if (value === null) {
      wrong(`${name} is "${field.value}"; allowed: a number such as 3.5u, 0.2meg, 1e-6 or inf`);
      return;
    }
    range.value = place(value, s);
    field.dataset.text = spice(value, s.unit, 6);
    changed(field.value.trim());
  });
  show(s.value === null ? Infinity : s.value);
  return { row, show, moved: (is) => row.classList.toggle("moved", is) };
}

/** The sliders of all elements, made anew where their names or ranges have changed. */
export class Sliders {
  constructor(parent, changed, wrong) {
    Object.assign(this, { parent, changed, wrong, key: "", byPath: new Map() });
  }

  /** Show the groups of a scene but that of the source whose waveform is chosen on the page. */
  update(groups, hidden, moved) {
    const shown = groups.filter((g) => g.element !== hidden);
    const key = JSON.stringify(shown.map((g) => g.sliders.map((s) => [s.path, s.low, s.high, s.log])));
    if (key !== this.key) this.build(shown, key);
    for (const group of shown) {
      for (const s of group.sliders) {
        const control = this.byPath.get(s.path);
        control.show(s.value === null ? Infinity : s.value);
        control.moved(s.path in moved);
      }
    }
  }

  build(groups, key) {
    this.key = key;
    this.byPath.clear();
    const open = new Set([...this.parent.querySelectorAll("details[open]")].map((d) => d.dataset.element));
    this.parent.replaceChildren();
    for (const group of groups) {
      const box = make("fieldset", {}, this.parent);
      const legend = make("legend", { textContent: `${group.element} ` }, box);
      make("small", { textContent: group.what }, legend);
      const more = make("details", { open: open.has(group.element) });
      more.dataset.element = group.element;
      make("summary", { textContent: "more values" }, more);
      for (const s of group.sliders) {
        const name = s.path.slice(group.element.length + 1);
        const control = slider({ ...s, name }, s.path, (text) => this.changed(s.path, text), this.wrong);
        this.byPath.set(s.path, control);
        (s.first ? box : more).append(control.row);
      }
      if (more.children.length > 1) box.append(more);
    }
  }
}

/** The menu of waveforms with the sliders of the one chosen, which are the numbers in the source's text. */
export class Waveforms {
  constructor(menu, changed, wrong) {
    const [kind, field, box] = ["kind", "source", "arguments"].map((id) => document.getElementById(id));
    Object.assign(this, { menu, changed, wrong, kind, field, box, shown: null });
    const options = menu.map((w) => new Option(w.title, w.kind));
    kind.append(new Option("the deck's own", ""), ...options, new Option("as the text says", "?"));
    this.kind.addEventListener("change", () => this.choose(this.kind.value));
    this.field.addEventListener("change", () => {
      this.field.dataset.text = this.field.value.trim();
      this.changed(this.field.dataset.text);
    });
  }

  choose(kind) {
    const one = this.menu.find((w) => w.kind === kind);
    this.shown = null;
    if (one) this.changed(`${kind}(${one.arguments.map((a) => spice(a.value, a.unit)).join(" ")})`);
    else if (kind === "") this.changed("");
    else this.field.focus();
  }

  /** The waveform that a text calls, with its numbers; null where it is no plain call of the menu's. */
  read(text) {
    const call = /^\s*(?:[\w.]+\s*=\s*)?([A-Za-z]+)\s*\(([^()]*)\)\s*$/.exec(text);
    const one = call && this.menu.find((w) => w.kind === call[1].toUpperCase());
    if (!one) return null;
    const values = call[2].trim().split(/[\s,]+/).map((word) => parse(word));
    for (const a of one.arguments.slice(values.length)) if (a.optional) values.push(a.value);
    if (values.length !== one.arguments.length || values.includes(null)) return null;
    return { one, values, before: text.slice(0, text.indexOf("(")) };
  }

  /** Show the source's text, and while there is none that of the deck's own waveform. */
  update(text, own) {
    write(this.field, text);
    this.field.placeholder = own || "the deck's own";
    const found = this.read(text);
    this.kind.value = found ? found.one.kind : text ? "?" : "";
    if (!found) {
      this.box.replaceChildren();
      this.shown = null;
      return;
    }
    if (this.shown !== found.one.kind) this.build(found);
    this.controls.forEach((control, i) => control.show(found.values[i]));
  }

  build({ one }) {
    this.shown = one.kind;
    this.box.replaceChildren();
    this.controls = one.arguments.map((a, i) => {
      const control = slider(a, `${one.title} ${a.name}`, (word) => {
        const now = this.read(this.field.value);
        if (!now) return;
        const words = now.values.map((value, k) => (k === i ? word : spice(value, now.one.arguments[k].unit, 12)));
        this.field.value = `${now.before}(${words.join(" ")})`;
        this.changed(this.field.value);
      }, this.wrong);
      this.box.append(control.row);
      return control;
    });
  }
}
