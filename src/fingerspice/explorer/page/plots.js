// Traces against time, harmonics, and mean force against frequency.

import { make } from "./controls.js";
import { quantity, scale } from "./units.js";

const COLOURS = ["#0a5a9c", "#b3400d", "#2c7a3f", "#7b3f9e", "#8a6d00", "#00707a", "#9c1f56", "#444"];
const GREY = "#9aa3ad";
const FONT = { font: "11px sans-serif", labelFont: "12px sans-serif" };
/** A value as the legend shows it. */
const shown = (_, v) => (v === null ? "–" : String(Number(v.toPrecision(5))));
/** Values in another unit, with gaps where there is none. */
const times = (values, by) => Array.from(values, (v) => (v === null ? null : v * by));
const PANELS = [
  { title: "voltage", signals: ["u_source", "u_gap", "u_layer", "v"], unit: "V", height: 145 },
  { title: "force", signals: ["f_el"], unit: "N", height: 115 },
  { title: "area", signals: ["area"], unit: "m^2", height: 105 },
  { title: "friction", signals: ["friction"], unit: "1", height: 105 },
];

/** Values at other times, by straight lines; null outside. */
function resampled(at, x, values) {
  let k = 0;
  return Array.from(at, (t) => {
    while (k < x.length - 2 && x[k + 1] < t) k += 1;
    const span = x[k + 1] - x[k];
    const share = span > 0 ? (t - x[k]) / span : 0;
    return share < -1e-6 || share > 1 + 1e-6 || x.length < 2 ? null : values[k] + share * (values[k + 1] - values[k]);
  });
}

function extreme(lists) {
  let most = 0;
  for (const list of lists) for (const x of list) if (x !== null && Math.abs(x) > most) most = Math.abs(x);
  return most;
}

/** Height of the axis of time, which the last panel has below it. */
const BELOW = 46;

const name = (trace) => (trace.element ? `${trace.label} ${trace.element}` : trace.label);

/** The panels of traces: the run of now, the last good one in grey where that failed, and the pinned one dashed. */
export class Traces {
  constructor(parent) {
    Object.assign(this, { parent, plots: [], key: "", failedAt: null });
    new ResizeObserver(() => this.resize()).observe(parent);
  }

  /** Draw runs; `good` is the last good one where `now` failed, else null. */
  show(now, good, pinned) {
    const base = good || now;
    const inPeriods = pinned && base.period && pinned.period && Math.abs(pinned.period / base.period - 1) > 1e-9;
    const x = (run) => (inPeriods ? run.t.map((t) => (t - run.t[0]) / run.period) : run.t);
    const layers = [{ run: base, grey: Boolean(good) }];
    if (good && now.t.length > 1) layers.push({ run: now });
    if (pinned) layers.push({ run: pinned, dashed: true });
    this.failedAt = now.ok || inPeriods ? null : now.failed_at;
    const at = x(base);
    const [factor, unit] = inPeriods ? [1, "periods"] : scale(at[at.length - 1] || 0, "s");
    const wanted = [];
    for (const panel of PANELS) {
      const series = layers.flatMap(({ run, grey, dashed }) =>
        run.traces.filter((t) => panel.signals.includes(t.signal)).map((t, i) => ({
          label: `${name(t)}${dashed ? ", pinned" : ""}${grey ? ", before" : ""}`, colour: grey ? GREY : COLOURS[i % COLOURS.length], dashed,
          values: run === base ? t.values : resampled(at, x(run), t.values),
        })));
      if (series.length) wanted.push({ panel, series });
    }
    const key = JSON.stringify(wanted.map((w) => [w.panel.title, w.series.map((s) => [s.label, s.colour, s.dashed])]));
    if (key !== this.key) this.build(wanted, key);
    this.factor = factor;
    const scaled = times(at, factor);
    wanted.forEach(({ panel, series }, i) => {
      const plot = this.plots[i];
      const [by, named] = scale(extreme(series.map((s) => s.values)), panel.unit);
      // All panels have one axis of time, below the last of them.
      if (i === wanted.length - 1) plot.axes[0].label = inPeriods ? "time (periods)" : `time (${unit})`;
      plot.axes[1].label = named ? `${panel.title} (${named})` : panel.title;
      plot.setData([scaled, ...series.map((s) => times(s.values, by))]);
    });
  }

  /** No run: no panels. */
  clear() {
    this.build([], "");
  }

  build(wanted, key) {
    this.key = key;
    for (const plot of this.plots) plot.destroy();
    this.parent.replaceChildren();
    this.plots = wanted.map(({ panel, series }, i) => {
      const box = make("div", { className: "panel" }, this.parent);
      const line = (s) => ({ label: s.label, stroke: s.colour, width: s.dashed ? 1.2 : 1.6, dash: s.dashed ? [6, 4] : undefined,
        pxAlign: 0, points: { show: false }, value: shown });
      const last = i === wanted.length - 1;
      const options = {
        width: this.width(), height: panel.height + (last ? BELOW : 0), cursor: { sync: { key: "time" } },
        scales: { x: { time: false } }, legend: { markers: { dash: (u, k) => (u.series[k].dash ? "dashed" : "solid") } },
        axes: [last ? { ...FONT, size: 32, labelSize: 18, label: "time" } : { ...FONT, size: 6, values: (_, splits) => splits.map(() => "") },
          { ...FONT, size: 58, labelSize: 20, space: 16, label: "" }],
        series: [{ label: "time", value: shown }, ...series.map(line)],
        hooks: { draw: [(u) => this.mark(u)] },
      };
      return new uPlot(options, [[], ...series.map(() => [])], box);
    });
  }

  /** A line at the time at which the run failed. */
  mark(u) {
    if (this.failedAt === null || this.failedAt === undefined) return;
    const at = u.valToPos(this.failedAt * this.factor, "x", true);
    const { left, top, width, height } = u.bbox;
    // A run that failed before what is shown has its line at the left edge.
    const x = Math.min(Math.max(at, left), left + width);
    u.ctx.save();
    u.ctx.fillStyle = "#a11212";
    u.ctx.fillRect(x - 1, top, 2, height);
    u.ctx.restore();
  }

  /** Put the cursors of all panels at an output, counted from 0; null takes them away. */
  point(at) {
    for (const plot of this.plots) {
      const left = at === null || plot.data[0].length <= at ? -10 : plot.valToPos(plot.data[0][at], "x");
      plot.setCursor({ left, top: at === null ? -10 : 0 }, false);
    }
  }

  width() {
    return Math.max(this.parent.clientWidth - 12, 260);
  }

  resize() {
    for (const plot of this.plots) plot.setSize({ width: this.width(), height: plot.height });
  }

  /** The panels as one picture, each with the names of its curves above it. */
  picture() {
    const ratio = window.devicePixelRatio || 1;
    const head = 20 * ratio;
    const canvas = document.createElement("canvas");
    canvas.width = Math.max(...this.plots.map((p) => p.ctx.canvas.width));
    canvas.height = this.plots.reduce((sum, p) => sum + p.ctx.canvas.height + head, 0);
    const context = canvas.getContext("2d");
    context.fillStyle = "#fff";
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.font = `${12 * ratio}px sans-serif`;
    context.textBaseline = "bottom";
    let top = 0;
    for (const plot of this.plots) {
      let left = 62 * ratio;
      for (const series of plot.series.slice(1).filter((s) => s.show)) {
        context.fillStyle = series.stroke();
        context.fillText(series.label, left, top + head);
        left += context.measureText(series.label).width + 24 * ratio;
      }
      context.drawImage(plot.ctx.canvas, 0, top + head);
      top += plot.ctx.canvas.height + head;
    }
    return canvas;
  }
}

/** A small plot against frequency with a title, in a panel of its own. */
class Small {
  title = "";
  plot = null;

  constructor(parent) {
    this.parent = parent;
    new ResizeObserver(() => this.plot && this.plot.width !== this.width() && this.plot.setSize({ width: this.width(), height: 190 })).observe(parent);
  }

  width() {
    return Math.max(this.parent.clientWidth - 12, 200);
  }

  clear(text = "") {
    if (this.plot) this.plot.destroy();
    this.plot = null;
    this.parent.replaceChildren();
    if (!text) return;
    make("h2", { textContent: this.title }, this.parent);
    make("p", { textContent: text }, this.parent);
  }

  draw(series, data, labels, scales) {
    if (!this.plot || this.plot.series.length !== series.length + 1) {
      this.clear();
      make("h2", { textContent: this.title }, this.parent);
      const axis = { ...FONT, labelSize: 18, label: "" };
      this.plot = new uPlot({ width: this.width(), height: 190, scales,
        axes: [{ ...axis, size: 30 }, { ...axis, size: 52, space: 28 }], cursor: { show: false },
        legend: { show: series.length > 1 && Boolean(series[0].label), live: false },
        series: [{}, ...series] }, data, this.parent);
    }
    this.plot.axes[0].label = labels[0];
    this.plot.axes[1].label = labels[1];
    this.plot.setData(data);
  }
}

/** Amplitudes of the friction force at the harmonics of the source. */
export class Harmonics extends Small {
  title = "harmonics of the friction force";

  show(harmonics) {
    if (!harmonics || !harmonics.length) {
      this.clear();
      return;
    }
    const [by, unit] = scale(extreme(harmonics.map((h) => h.amplitude)), "N");
    const [fBy, fUnit] = scale(harmonics[0].frequency[0], "Hz");
    // Of several fingers, the bars of the later ones are narrower and stand inside those before them.
    const bars = harmonics.map((_, i) => uPlot.paths.bars({ size: [0.5 / (i + 1), 24 / (i + 1)] }));
    const series = harmonics.map((h, i) => ({ label: h.element, stroke: COLOURS[i], fill: `${COLOURS[i]}80`, paths: bars[i], points: { show: false } }));
    this.draw(series, [times(harmonics[0].frequency, fBy), ...harmonics.map((h) => times(h.amplitude, by))], [`frequency (${fUnit})`, `amplitude (${unit})`],
      { x: { time: false, range: (u) => [0, u.data[0][u.data[0].length - 1] + u.data[0][0]] }, y: { range: (u, low, high) => [0, high * 1.05 || 1] } });
  }
}

/** Mean force against frequency, with a dot at the run of now. */
export class Means extends Small {
  /** `points` are pairs of frequency (Hz) and force (N), ascending; `here` is one such pair or null. */
  show(points, here, text, amplitude, finger) {
    const title = `mean force${finger ? ` at ${finger}` : ""} of a sine${amplitude ? ` of ${amplitude}` : ""} against its frequency`;
    if (title !== this.title) this.clear();
    this.title = title;
    const all = [...points.map(([f, y]) => [f, y, null]), ...(here ? [[here[0], null, here[1]]] : [])].sort((a, b) => a[0] - b[0]);
    if (!points.length) {
      this.clear(text);
      return;
    }
    const [by, unit] = scale(extreme([all.map((p) => p[1]), all.map((p) => p[2])]), "N");
    const series = [{ stroke: COLOURS[0], width: 1.6, spanGaps: true, points: { show: true, size: 4 } },
      { stroke: COLOURS[1], width: 0, points: { show: true, size: 10, fill: COLOURS[1] } }];
    this.draw(series, [all.map((p) => p[0]), ...[1, 2].map((i) => times(all.map((p) => p[i]), by))],
      ["frequency (Hz)", `mean force (${unit})`], { x: { time: false, distr: 3 }, y: { range: (u, low, high) => [0, high * 1.08 || 1] } });
    this.plot.axes[0].values = (u, splits) => splits.map((f) => (f !== null && /^1e/.test(f.toExponential()) ? quantity(f, "Hz", 2).replace(" Hz", "").replace("Hz", "") : ""));
    this.plot.redraw(false, true);
  }
}
