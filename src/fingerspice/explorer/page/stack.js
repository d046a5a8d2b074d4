// A drawing of the stack that moves with the traces in slow motion.

import { make } from "./controls.js";
import { quantity } from "./units.js";

/** Seconds in which the traces shown go by. */
const DURATION = 8;
/** Heights: of the drawing, of the finger above the layers and of the screen below them, and of the scale of colours. */
const HEIGHT = 236;
const FINGER = 26;
const SCREEN = 22;
const SCALE = 30;
const INK = "#1c2430";

/** White for no voltage, red for positive and blue for negative ones. */
function colour(share) {
  const s = Math.min(Math.abs(share), 1);
  const [r, g, b] = share > 0 ? [196, 62, 28] : [20, 90, 170];
  return `rgb(${[r, g, b].map((c) => Math.round(255 - s * (255 - c))).join(",")})`;
}

const largestOf = (values) => values.reduce((most, u) => Math.max(most, Math.abs(u)), 0);

/** Layers as bars: height by thickness (logarithmic), colour by voltage, width by the ridge contact area. */
export class Stack {
  constructor(parent, point) {
    Object.assign(this, { parent, point, stacks: [], playing: false, canvas: make("canvas") });
    this.canvas.setAttribute("role", "img");
    this.button = make("button", { type: "button", textContent: "Play in slow motion" });
    this.button.addEventListener("click", () => this.play(!this.playing));
    this.title = make("h2", { textContent: "the stack" });
    this.note = make("p");
    new ResizeObserver(() => this.stacks.length && !this.playing && this.draw()).observe(parent);
  }

  show(answer) {
    this.stacks = (answer.stacks || []).map((s) => {
      const area = answer.traces.find((t) => t.signal === "area" && (t.element === s.gap || !t.element));
      return { area: area.values, layers: s.layers, gap: s.layers.find((l) => l.name === s.gap) };
    });
    this.t = answer.t;
    if (!this.stacks.length) {
      this.play(false);
      this.parent.replaceChildren();
      return;
    }
    if (!this.canvas.isConnected) this.parent.replaceChildren(this.title, this.canvas, this.note, this.button);
    const layers = this.stacks.flatMap((s) => s.layers);
    this.largest = Math.max(1e-12, ...layers.map((layer) => largestOf(layer.values)));
    this.widest = Math.max(...this.stacks.map((s) => largestOf(s.area)));
    this.canvas.setAttribute("aria-label", `The finger above, the screen below; layers: ${layers.map((l) => `${l.name}, ${quantity(l.d, "m")}`).join("; ")}`);
    if (this.playing) return;
    // At rest the drawing shows the moment at which the first gap has most voltage.
    const voltage = this.stacks[0].gap.values;
    const most = largestOf(voltage);
    this.at = voltage.findIndex((u) => Math.abs(u) === most);
    this.draw();
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
    c.fillStyle = "#d5dae0";
    c.fillRect(0, HEIGHT - SCALE - SCREEN, width, SCREEN);
    c.fillStyle = INK;
    c.fillText("screen with its electrode", width / 2, HEIGHT - SCALE - SCREEN / 2, width - 8);
    this.scale(c, width);
    const areas = this.stacks.map((stack) => quantity(stack.area[at], "m^2", 4)).join(" and ");
    this.note.textContent = `t = ${quantity(this.t[at], "s")}. Width: contact area, ${areas}. Heights are logarithmic, not to scale.`;
  }

  /** What the colours mean. */
  scale(c, width) {
    const [top, height] = [HEIGHT - SCALE + 6, 8];
    for (let x = 0; x < width - 2; x += 1) {
      c.fillStyle = colour((2 * x) / (width - 2) - 1);
      c.fillRect(x + 1, top, 1, height);
    }
    c.strokeStyle = "#55606e";
    c.strokeRect(0.5, top, width - 1, height);
    c.fillStyle = INK;
    const end = quantity(this.largest, "V", 3);
    const below = top + height + 8;
    c.fillText("0 V across the layer", width / 2, below, width - 140);
    c.textAlign = "left";
    c.fillText(`−${end}`, 1, below);
    c.textAlign = "right";
    c.fillText(`+${end}`, width - 1, below);
    c.textAlign = "center";
  }

  column(c, stack, left, column, at) {
    const heights = stack.layers.map((layer) => Math.max(1, Math.log10(layer.d / 1e-8)));
    const total = heights.reduce((sum, h) => sum + h, 0);
    const width = (column - 16) * (stack.area[at] / this.widest);
    const middle = left + column / 2;
    const room = HEIGHT - FINGER - SCREEN - SCALE;
    c.fillStyle = "#ecd9c9";
    c.strokeStyle = "#55606e";
    c.beginPath();
    c.ellipse(middle, FINGER, (column - 8) / 2, FINGER - 1, 0, Math.PI, 2 * Math.PI);
    c.fill();
    c.fillStyle = INK;
    c.fillText("finger", middle, FINGER / 2 + 3, column - 16);
    let top = FINGER;
    // The finger is above and the screen below: the layers begin at the drive.
    [...stack.layers].map((layer, i) => [layer, heights[i]]).reverse().forEach(([layer, share]) => {
      const height = (room * share) / total;
      // What is left of a voltage after the rounding of larger ones is nought.
      const u = Math.abs(layer.values[at]) < 1e-9 * this.largest ? 0 : layer.values[at];
      c.fillStyle = colour(u / this.largest);
      c.fillRect(middle - width / 2, top, width, height);
      c.strokeRect(middle - width / 2, top, width, height);
      c.fillStyle = Math.abs(u) > 0.6 * this.largest ? "#fff" : INK;
      const [name, value] = [`${layer.name} (${quantity(layer.d, "m", 3)})`, quantity(u, "V", 3)];
      const wide = c.measureText(`${name}: ${value}`).width < width - 8;
      // A narrow column has its name and its voltage one below the other, where the layer is high enough.
      const lines = wide || height < 26 ? [`${name}: ${value}`] : [c.measureText(name).width < width - 8 ? name : layer.name, value];
      lines.forEach((line, i) => c.fillText(line, middle, top + height / 2 + 13 * (i - (lines.length - 1) / 2), width - 6));
      top += height;
    });
  }
}
