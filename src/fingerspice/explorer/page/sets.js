// Named sets of parameters: the menu, and what is said of those whose values are in force.

import { make } from "./controls.js";

const KINDS = { finger: "finger", load: "load", coating: "coating", drive: "drive", scene: "whole scene" };
/** Devices with values that a set may give. */
const GIVEN = ["GAP", "LAYER", "SKIN", "SKIN_DISPERSIVE", "V"];

export class Sets {
  /** `apply(entry)` applies a set: NAME, or ELEMENT=NAME. */
  constructor(menu, apply) {
    [this.menu, this.to, this.list] = ["apply", "to", "sets"].map((id) => document.getElementById(id));
    this.key = "";
    this.menu.append(new Option("choose a set", ""));
    for (const [kind, label] of Object.entries(KINDS)) {
      const group = make("optgroup", { label }, this.menu);
      group.append(...menu.filter((one) => one.kind === kind).map((one) => new Option(`${one.name}: ${one.title}`, one.name)));
    }
    this.menu.addEventListener("change", () => {
      if (this.menu.value) apply(this.to.value ? `${this.to.value}=${this.menu.value}` : this.menu.value);
      this.menu.value = "";
    });
  }

  /** Show the sets in force in a scene, and the elements to which a set may go. */
  show(answer) {
    const key = JSON.stringify([answer.sets, answer.sliders.map((g) => [g.element, g.device])]);
    if (key === this.key) return;
    this.key = key;
    this.choices(answer.sliders.filter((g) => GIVEN.includes(g.device)));
    this.list.replaceChildren(...(answer.sets || []).map((one) => {
      const item = make("li");
      const say = (textContent) => make("span", { textContent }, item);
      make("b", { textContent: one.to ? `${one.name}, ${one.to}` : one.name }, item);
      item.append(` ${one.title}. `);
      if (one.assumed.length) say(`Assumed, not published: ${one.assumed.join(", ")}. `);
      if (one.changed.length) say(`Changed since: ${one.changed.join(", ")}. `);
      say(`Not claimed: ${one.caveat}`);
      return item;
    }));
  }

  /** Where a circuit has several elements of a kind, the user may choose to which a set goes. */
  choices(groups) {
    const several = groups.some((a) => groups.some((b) => a !== b && a.device === b.device));
    const names = groups.map((g) => g.element);
    const inside = names.flatMap((name) => name.split(".").slice(0, -1).map((_, i, parts) => parts.slice(0, i + 1).join(".")));
    const now = this.to.value;
    this.to.replaceChildren(new Option("all of the circuit", ""), ...[...new Set([...inside, ...names])].map((name) => new Option(name, name)));
    this.to.value = several && [...this.to.options].some((o) => o.value === now) ? now : "";
    this.to.parentElement.hidden = !several;
  }
}
