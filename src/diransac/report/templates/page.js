"use strict";
// Zooming and reading of the figures. A plot's x is the log's row, its y thousandths of the range in data-low, data-high.
(() => {
  const HEIGHT = 1000;
  const group = (element) => element.closest("[data-log]") || document.querySelector("[data-log]");
  const plots = [...document.querySelectorAll("svg.plot:not(.still)")].map((svg) => {
    const [x, y, width, height] = svg.getAttribute("viewBox").split(" ").map(Number);
    const { low, high, start, dt } = svg.dataset;
    const home = { x, y, width, height }, box = { x, y, width, height };
    return { svg, log: group(svg), home, box, low: +low, high: +high, start: +start, dt: +dt };
  });
  const beside = (log) => plots.filter((plot) => plot.log === log); // the plots of one log, which zoom together
  const make = (name, parent) => {
    const element = document.createElement("div");
    element.className = name;
    element.hidden = true;
    parent.append(element);
    return element;
  };
  const readout = make("readout", document.body);
  plots.forEach((plot) => { plot.pointer = make("pointer", plot.svg.parentNode); });

  // ---- axes
  const ticks = (low, high, about) => {
    const rough = (high - low) / about;
    const decade = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((k) => k * decade).find((s) => s >= rough * 0.7);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) found.push(k * step);
    const magnitude = Math.floor(Math.log10(step) + 1e-9);
    return found.map((x) => [x, text(x, magnitude)]);
  };
  const text = (x, magnitude) => {
    if (magnitude >= -6 && Math.abs(x) < 1e5) return x.toFixed(Math.max(0, -magnitude)).replace("-", "−");
    if (x === 0) return "0";
    const digits = Math.max(0, Math.floor(Math.log10(Math.abs(x)) + 1e-9) - magnitude);
    return x.toExponential(Math.min(digits, 20)).replace("+", "").replace(/-/g, "−");
  };
  const label = (parent, kind, marks) => parent.replaceChildren(...marks.map(([part, words]) => {
    const span = document.createElement("span");
    span.className = `tick ${kind}`;
    span.style[kind === "x" ? "left" : "top"] = `${100 * part}%`;
    span.textContent = words;
    return span;
  }));
  const value = (plot, y) => plot.high - (y / HEIGHT) * (plot.high - plot.low);
  const draw = (plot) => {
    const { svg, box } = plot;
    svg.setAttribute("viewBox", `${box.x} ${box.y} ${box.width} ${box.height}`);
    const grid = svg.querySelector(".grid");
    if (grid) {
      const bottom = value(plot, box.y + box.height), top = value(plot, box.y);
      const heights = ticks(bottom, top, 4).map(([v, words]) => [(top - v) / (top - bottom), words]);
      label(svg.parentNode.querySelector(".ticks"), "y", heights);
      const width = plot.home.width;
      grid.setAttribute("d", heights.map(([part]) => `M0 ${box.y + part * box.height}h${width}`).join(""));
    }
    if (plot.button) plot.button.textContent = box.height === plot.home.height ? "Show" : "Back";
    const axis = svg.closest("figure").querySelector(".times");
    const from = plot.start + plot.dt * box.x, span = plot.dt * box.width;
    label(axis, "x", ticks(from, from + span, 5).map(([t, words]) => [(t - from) / span, words]));
  };
  const show = (log, x, width) => {
    const together = beside(log), { home } = together[0];
    const wide = Math.min(Math.max(width, 4), home.width);
    const left = Math.min(Math.max(x, 0), home.width - wide);
    together.forEach((plot) => { Object.assign(plot.box, { x: left, width: wide }); draw(plot); });
    const isWhole = wide === home.width && together.every(({ box, home: all }) => box.height === all.height);
    log.querySelector(".reset").hidden = isWhole;
  };
  const showAll = (log) => {
    beside(log).forEach((plot) => { Object.assign(plot.box, plot.home); });
    show(log, 0, beside(log)[0].home.width);
  };

  // ---- reading
  const samples = (path) => {
    if (!path.samples) {
      let x = 0, y = 0;
      const steps = path.getAttribute("d").replace(/h0/g, "").match(/-?\d+/g).map(Number);
      path.samples = [];
      for (let k = 0; k < steps.length; k += 2) path.samples.push([x += steps[k], y += steps[k + 1]]);
    }
    return path.samples;
  };
  const nearest = (list, x) => {
    let low = 0, high = list.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (list[middle][0] <= x) low = middle; else high = middle;
    }
    return x - list[low][0] <= list[high][0] - x ? list[low] : list[high];
  };
  const line = (name, words, look) => {
    const row = document.createElement("div");
    const key = document.createElement("span"), shown = document.createElement("span");
    key.textContent = name;
    key.className = look;
    shown.textContent = words;
    row.append(key, shown);
    return row;
  };
  const part = (plot, event) => {
    const frame = plot.svg.getBoundingClientRect();
    const clamp = (x) => Math.min(Math.max(x, 0), 1);
    return [clamp((event.clientX - frame.left) / frame.width), clamp((event.clientY - frame.top) / frame.height)];
  };
  const read = (plot, event) => {
    const [along] = part(plot, event);
    const x = plot.box.x + along * plot.box.width, reach = Math.max(1, plot.box.width / 150);
    const rows = [line("t", `${+(plot.start + plot.dt * Math.round(x)).toPrecision(7)} s`, "")];
    plot.svg.querySelectorAll(".trace:not(.off)").forEach((path) => {
      const [row, y] = nearest(samples(path), x);
      const look = path.getAttribute("class").replace(/trace|line|dots/g, "").trim();
      if (Math.abs(row - x) <= reach || !path.classList.contains("dots")) {
        rows.push(line(path.dataset.name, `${+value(plot, y).toPrecision(4)}`.replace("-", "−"), look));
      }
    });
    readout.replaceChildren(...rows);
    readout.hidden = false;
    const left = event.clientX + 16 + readout.offsetWidth > window.innerWidth;
    readout.style.left = `${event.clientX + (left ? -16 - readout.offsetWidth : 16)}px`;
    readout.style.top = `${Math.min(event.clientY + 16, window.innerHeight - readout.offsetHeight - 4)}px`;
    beside(plot.log).forEach(({ svg, pointer }) => {
      const panel = svg.parentNode.getBoundingClientRect(), frame = svg.getBoundingClientRect();
      pointer.style.left = `${frame.left - panel.left + along * frame.width}px`;
      pointer.hidden = false;
    });
  };
  const leave = () => {
    readout.hidden = true;
    plots.forEach(({ pointer }) => { pointer.hidden = true; });
  };

  // ---- zooming
  const choose = (plot, from, to) => {
    const { box, svg } = plot;
    const [left, right] = [from[0], to[0]].sort((a, b) => a - b);
    const [top, bottom] = [from[1], to[1]].sort((a, b) => a - b);
    const frame = svg.getBoundingClientRect();
    if ((bottom - top) * frame.height > 25 && svg.querySelector(".grid")) {
      Object.assign(box, { y: box.y + top * box.height, height: (bottom - top) * box.height });
    }
    const wide = (right - left) * frame.width > 8;
    show(plot.log, box.x + (wide ? left * box.width : 0), wide ? (right - left) * box.width : box.width);
  };
  const outline = (choice, plot, from, to) => {
    const panel = plot.svg.parentNode.getBoundingClientRect(), frame = plot.svg.getBoundingClientRect();
    const tall = Math.abs(to[1] - from[1]) * frame.height > 25;
    choice.style.left = `${frame.left - panel.left + Math.min(from[0], to[0]) * frame.width}px`;
    choice.style.width = `${Math.abs(to[0] - from[0]) * frame.width}px`;
    choice.style.top = `${tall ? Math.min(from[1], to[1]) * frame.height : 0}px`;
    choice.style.height = `${(tall ? Math.abs(to[1] - from[1]) : 1) * frame.height}px`;
    choice.hidden = false;
  };
  const keys = {
    ArrowLeft: ({ x, width }) => [x - width / 5, width],
    ArrowRight: ({ x, width }) => [x + width / 5, width],
    "+": ({ x, width }) => [x + width / 4, width / 2],
    "-": ({ x, width }) => [x - width / 2, width * 2],
  };
  plots.forEach((plot) => {
    const { svg } = plot;
    const choice = make("choice", svg.parentNode);
    let from = null;
    svg.addEventListener("pointerdown", (event) => {
      if (event.button || event.pointerType === "touch") return;
      from = part(plot, event);
      svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", (event) => {
      read(plot, event);
      if (from) outline(choice, plot, from, part(plot, event));
    });
    svg.addEventListener("pointerup", (event) => {
      choice.hidden = true;
      if (from) {
        const frame = svg.getBoundingClientRect(), to = part(plot, event);
        const moved = Math.hypot((to[0] - from[0]) * frame.width, (to[1] - from[1]) * frame.height);
        if (moved > 8) choose(plot, from, to);
      }
      from = null;
    });
    svg.addEventListener("pointerleave", leave);
    svg.addEventListener("dblclick", () => showAll(plot.log));
    svg.addEventListener("keydown", (event) => {
      if (event.key === "0" || event.key === "Escape") showAll(plot.log);
      else if (keys[event.key]) show(plot.log, ...keys[event.key](plot.box));
      else return;
      event.preventDefault();
    });
  });

  // ---- buttons
  document.querySelectorAll("input[data-shows]").forEach((input) => {
    input.hidden = false;
    input.addEventListener("change", () => {
      const paths = group(input).querySelectorAll(`.plot .${input.dataset.shows}`);
      paths.forEach((path) => path.classList.toggle("off", !input.checked));
    });
  });
  document.querySelectorAll("button.full").forEach((button) => {
    const plot = plots.find(({ svg }) => svg === button.closest("figure").querySelector("svg.plot"));
    const [top, bottom] = plot.svg.dataset.full.split(" ").map(Number);
    const margin = 0.05 * (bottom - top);
    plot.button = button;
    button.hidden = false;
    button.addEventListener("click", () => {
      const whole = plot.box.height === plot.home.height;
      const { y, height } = whole ? { y: top - margin, height: bottom - top + 2 * margin } : plot.home;
      Object.assign(plot.box, { y, height });
      show(plot.log, plot.box.x, plot.box.width);
    });
  });
  document.querySelectorAll(".reset").forEach((button) => button.addEventListener("click", () => showAll(group(button))));

  // ---- printing: every log is opened, then closed again
  let closed = [];
  window.addEventListener("beforeprint", () => {
    closed = [...document.querySelectorAll("details:not([open])")];
    closed.forEach((details) => { details.open = true; });
  });
  window.addEventListener("afterprint", () => { closed.forEach((details) => { details.open = false; }); });
})();
