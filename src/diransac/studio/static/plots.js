/* global uPlot */
import { h, numbers, number, put } from "./page.js";

// Signals over one time axis, thinned out by the server to the pixels that there are.
const KEYS = { ArrowLeft: [-0.2, 1], ArrowRight: [0.2, 1], "+": [0, 0.5], "=": [0, 0.5], "-": [0, 2] };
const color = (name) => {
  const probe = document.body.appendChild(h("i"));
  probe.style.color = `var(--${name})`;
  const found = getComputedStyle(probe).color;
  probe.remove();
  return found;
};
const values = (array) => Array.from(array, (x) => (Number.isNaN(x) ? null : x));

export class Plots {
  constructor(root, { left, leave }) {
    Object.assign(this, { root, left, leave, plots: new Map(), mode: "zoom", names: [], file: "" });
    this.readout = h(".readout");
    this.box = h(".plots");
    put(root, this.readout, this.box);
    this.sync = uPlot.sync(`plots${Math.random()}`);
    const again = () => {
      if (root.isConnected) this.rebuild();
    };
    addEventListener("look", again);
    new ResizeObserver(() => {
      if (this.box.clientWidth && this.box.clientWidth !== this.width) {
        this.width = this.box.clientWidth;
        this.plots.forEach(({ plot }) => plot.setSize({ width: this.width, height: this.height }));
        this.fetch();
      }
    }).observe(this.box);
  }

  get height() {
    return Math.max(92, Math.min(150, 640 / Math.max(1, this.names.length)));
  }

  show(file, facts, names) {
    const same =
      this.file === file && this.rows === facts.rows && this.start === facts.start && this.dt === facts.dt;
    if (same && names.join("\n") === this.names.join("\n")) {
      this.plots.forEach(({ plot }) => plot.redraw(false));
      return;
    }
    this.home = [facts.start, facts.start + facts.dt * (facts.rows - 1)];
    if (!same) this.range = [...this.home];
    Object.assign(this, {
      file,
      names,
      rows: facts.rows,
      start: facts.start,
      dt: facts.dt,
      units: Object.fromEntries(facts.signals.map((x) => [x.name, x.unit])),
    });
    this.rebuild();
  }

  rebuild() {
    this.plots.forEach(({ plot }) => plot.destroy());
    this.plots.clear();
    this.width = this.box.clientWidth || 600;
    const [grid, ink, line, mark] = ["rule", "muted", "c0", "outlier"].map(color);
    put(
      this.box,
      this.names.map((name, k) => {
        const count = h("span"),
          frame = h(
            ".plot",
            { tabIndex: 0, onkeydown: (event) => this.key(event), "aria-label": `${name} over time` },
            h("h4", name, h("small.unit", this.units[name] ? ` ${this.units[name]}` : ""), count),
          );
        const axis = {
          stroke: ink,
          grid: { stroke: grid, width: 1 },
          ticks: { show: false },
          font: "11px system-ui",
        };
        const plot = new uPlot(
          {
            width: this.width,
            height: this.height,
            legend: { show: false },
            padding: [8, 8, 0, 0],
            cursor: {
              sync: { key: this.sync.key, setSeries: false },
              drag: { x: true, y: false, setScale: false },
              points: { show: false },
            },
            scales: { x: { time: false, range: () => this.range } },
            axes: [
              {
                ...axis,
                size: k === this.names.length - 1 ? 26 : 16,
                values:
                  k === this.names.length - 1
                    ? (_, ticks) => ticks.map((x) => `${number(x, 7)} s`)
                    : () => [],
              },
              { ...axis, size: 62, values: (_, ticks) => ticks.map((x) => number(x, 5)) },
            ],
            series: [
              {},
              { stroke: line, width: 1, points: { show: false } },
              { stroke: mark, paths: () => null, points: { show: true, size: 5, fill: mark, stroke: mark } },
            ],
            hooks: {
              drawClear: [(u) => this.shade(u)],
              setSelect: [(u) => this.select(u)],
              setCursor: [(u) => this.read(u)],
              ready: [
                (u) => {
                  u.over.addEventListener("dblclick", () => this.zoom(...this.home));
                  u.over.addEventListener("wheel", (event) => this.wheel(u, event), { passive: false });
                },
              ],
            },
          },
          [[], [], []],
          frame,
        );
        this.plots.set(name, { plot, count });
        this.sync.sub(plot);
        return frame;
      }),
    );
    this.fetch();
  }

  async fetch() {
    if (!this.names.length || !this.file) return;
    this.asked?.abort();
    const asked = (this.asked = new AbortController()),
      [begin, end] = this.range;
    const query = [
      ["name", this.file],
      ["begin", begin],
      ["end", end],
      ["width", Math.min(1500, this.width)],
      ...this.names.map((x) => ["signal", x]),
    ];
    // A reader of an answer: the next numbers of it.
    const answer = async (...more) => {
      const found = new Float64Array(await numbers("series", [...query, ...more], asked.signal));
      let at = 0;
      return (n) => found.subarray(at, (at += n));
    };
    this.box.classList.add("busy");
    try {
      const next = await answer();
      for (const name of this.names) {
        const [start, step, n] = next(3);
        this.fill(name, { lines: this.merged(start, step, next(n), next(n)), marks: null });
      }
      this.root.dataset.painted = `${begin} ${end}`;
      this.box.classList.remove("busy");
      await new Promise((done) => setTimeout(done, 150)); // a search that nobody waits for while the view moves
      const nextMark = await answer(["outliers", 1]);
      for (const name of this.names) {
        const [n, total] = nextMark(2);
        this.fill(name, { marks: [nextMark(n), nextMark(n)], total });
      }
    } catch (error) {
      if (error.name !== "AbortError") put(this.readout, error.message);
    } finally {
      if (this.asked === asked) this.box.classList.remove("busy");
    }
  }

  fill(name, found) {
    const shown = this.plots.get(name);
    if (!shown) return;
    Object.assign(shown, found);
    const { plot, count, lines, marks } = shown;
    if (found.total)
      put(
        count,
        found.total > 0
          ? `${found.total} outlier${found.total > 1 ? "s" : ""}`
          : "too long to be searched for outliers",
      );
    plot.setData(marks ? this.marked(lines, marks) : [...lines, lines[0].map(() => null)]);
  }

  merged(start, step, low, high) {
    const thin = low.some((x, k) => x !== high[k] && !Number.isNaN(x)),
      t = [],
      y = [];
    for (let k = 0; k < low.length; k += 1) {
      const up = !thin || k % 2 === 0,
        x = start + k * step;
      t.push(x);
      y.push(up ? low[k] : high[k]);
      if (thin) {
        t.push(x);
        y.push(up ? high[k] : low[k]);
      }
    }
    return [t, values(y)];
  }

  marked([t, y], [times, marked]) {
    const all = [
      ...t.map((x, k) => [x, y[k], null]),
      ...Array.from(times, (x, k) => [x, undefined, marked[k]]),
    ].sort((a, b) => a[0] - b[0]);
    return [0, 1, 2].map((k) => all.map((x) => x[k]));
  }

  zoom(begin, end) {
    const [first, last] = this.home,
      least = 4 * this.dt,
      wide = Math.min(Math.max(end - begin, least), last - first);
    const from = Math.min(Math.max(begin, first), last - wide);
    this.range = [from, from + wide];
    this.plots.forEach(({ plot }) => plot.setScale("x", { min: this.range[0], max: this.range[1] }));
    clearTimeout(this.soon);
    this.soon = setTimeout(() => this.fetch(), 15);
  }

  wheel(u, event) {
    if (!event.ctrlKey && !event.shiftKey) return;
    event.preventDefault();
    const at = u.posToVal(u.cursor.left, "x"),
      factor = (event.deltaY || event.deltaX) > 0 ? 1.25 : 0.8,
      [a, b] = this.range;
    this.zoom(at - (at - a) * factor, at + (b - at) * factor);
  }

  key(event) {
    const [a, b] = this.range,
      step = KEYS[event.key];
    if (event.key === "0" || event.key === "Escape") this.zoom(...this.home);
    else if (step) {
      const middle = (a + b) / 2 + step[0] * (b - a),
        half = ((b - a) * step[1]) / 2;
      this.zoom(middle - half, middle + half);
    } else return;
    event.preventDefault();
  }

  select(u) {
    const { left, width } = u.select;
    if (width < 3) return;
    const ends = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
    u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    if (this.mode === "leave")
      this.leave(ends.map((x) => +x.toFixed(Math.max(0, Math.ceil(-Math.log10(this.dt)) + 1))));
    else this.zoom(...ends);
  }

  shade(u) {
    u.ctx.save();
    u.ctx.fillStyle = "rgb(213 94 0 / 18%)";
    for (const [a, b] of this.left()) {
      const from = u.valToPos(Math.max(a, this.range[0]), "x", true),
        to = u.valToPos(Math.min(b, this.range[1]), "x", true);
      if (to > from) u.ctx.fillRect(from, u.bbox.top, to - from, u.bbox.height);
    }
    u.ctx.restore();
  }

  read(u) {
    const { idx, left } = u.cursor;
    if (left < 0 || idx === null || idx === undefined) return;
    const t = u.posToVal(left, "x"),
      parts = [`t = ${number(t, 8)} s`];
    this.plots.forEach(({ plot }, name) => {
      const place = plot.valToIdx(t),
        y = plot.data[1][place] ?? plot.data[2][place];
      if (parts.length < 13 && y !== undefined) parts.push(`${name} = ${number(y)}`);
    });
    put(this.readout, parts.join("   "));
  }
}
