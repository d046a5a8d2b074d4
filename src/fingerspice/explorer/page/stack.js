// A drawing of the stack that moves with the traces in slow motion.

import { quantity } from "./units.js";

/** Seconds in which the traces shown go by. */
const DURATION = 8;
const HEIGHT = 190;

/** White for no voltage, red for positive and blue for negative ones. */
function colour(share) {
  const s = Math.min(Math.abs(share), 1);
  const [r, g, b] = share > 0 ? [196, 62, 28] : [20, 90, 170];
  return `rgb(${[r, g, b].map((c) => Math.round(255 - s * (255 - c))).join(",")})`;
}

/** Layers as bars: height by thickness (logarithmic), colour by voltage, width by the ridge contact area. */
export class Stack {
  constructor(parent, point) {
    this.parent = parent;
    this.point = point;
    this.stacks = [];
    this.playing = false;
    this.at = 0;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.button = Object.assign(document.createElement("button"), { type: "button", textContent: "Play in slow motion" });
    this.button.addEventListener("click", () => this.play(!this.playing));
    this.title = Object.assign(document.createElement("h2"), { textContent: "the stack" });
    this.note = document.createElement("p");
    new ResizeObserver(() => this.stacks.length && !this.playing && this.draw()).observe(parent);
  }

  show(answer) {
    this.stacks = (answer.stacks || []).map((s) => {
      const area = answer.traces.find((t) => t.signal === "area" && (t.element === s.gap || !t.element));
      return { area: area.values, layers: s.layers };
    });
    this.t = answer.t;
    if (!this.stacks.length) {
      this.play(false);
      this.parent.replaceChildren();
      return;
    }
    if (!this.canvas.isConnected) this.parent.replaceChildren(this.title, this.canvas, this.note, this.button);
    const layers = this.stacks.flatMap((s) => s.layers);
    this.largest = Math.max(1e-12, ...layers.map((layer) => layer.values.reduce((most, u) => Math.max(most, Math.abs(u)), 0)));
    this.widest = Math.max(...this.stacks.map((s) => s.area.reduce((most, a) => Math.max(most, a), 0)));
    this.canvas.setAttribute("aria-label", `Layers: ${layers.map((l) => `${l.name}, ${quantity(l.d, "m")}`).join("; ")}`);
    if (!this.playing) this.draw();
  }

  play(on) {
    this.playing = on;
    this.button.textContent = on ? "Stop" : "Play in slow motion";
    if (on) {
      this.begin = performance.now() - (this.at / this.t.length) * DURATION * 1000;
      requestAnimationFrame(() => this.step());
    } else this.point(null);
  }

  step() {
    if (!this.playing) return;
    const share = ((performance.now() - this.begin) / (DURATION * 1000)) % 1;
    this.at = Math.floor(share * this.t.length);
    this.draw();
    this.point(this.at);
    requestAnimationFrame(() => this.step());
  }

  draw() {
    const width = Math.max(this.parent.clientWidth - 12, 200);
    const ratio = window.devicePixelRatio || 1;
    if (this.canvas.width !== Math.round(width * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = HEIGHT * ratio;
      Object.assign(this.canvas.style, { width: `${width}px`, height: `${HEIGHT}px` });
    }
    const at = Math.min(this.at, this.t.length - 1);
    const c = this.canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, HEIGHT);
    c.font = "11px sans-serif";
    c.textAlign = "center";
    c.textBaseline = "middle";
    const column = width / this.stacks.length;
    this.stacks.forEach((stack, i) => this.column(c, stack, i * column, column, at));
    this.note.textContent = `t = ${quantity(this.t[at], "s")}; width: contact area; colour: voltage, up to ${quantity(this.largest, "V", 3)}; heights logarithmic`;
  }

  column(c, stack, left, column, at) {
    const heights = stack.layers.map((layer) => Math.max(1, Math.log10(layer.d / 1e-8)));
    const total = heights.reduce((sum, h) => sum + h, 0);
    const width = (column - 16) * (stack.area[at] / this.widest);
    let top = 4;
    // The finger is above and the screen below: the layers begin at the drive.
    [...stack.layers].map((layer, i) => [layer, heights[i]]).reverse().forEach(([layer, share]) => {
      const height = ((HEIGHT - 8) * share) / total;
      c.fillStyle = colour(layer.values[at] / this.largest);
      c.strokeStyle = "#55606e";
      const x = left + (column - width) / 2;
      c.fillRect(x, top, width, height - 1);
      c.strokeRect(x, top, width, height - 1);
      c.fillStyle = Math.abs(layer.values[at]) > 0.6 * this.largest ? "#fff" : "#1c2430";
      c.fillText(`${layer.name}  ${quantity(layer.values[at], "V", 3)}`, left + column / 2, top + height / 2, width - 8);
      top += height;
    });
  }
}
