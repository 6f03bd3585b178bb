import { change, choice, h, number, post, put, run, table } from "./page.js";

const METHODS = ["lo-diransac", "i-diransac", "diransac", "nls", "ols", "tls"];
const spark = (values) => {
  const low = Math.min(...values),
    wide = Math.max(...values) - low || 1,
    NS = "http://www.w3.org/2000/svg";
  const svg = document.createElementNS(NS, "svg"),
    line = document.createElementNS(NS, "polyline");
  svg.setAttribute("viewBox", "0 0 80 18");
  svg.setAttribute("width", "80");
  svg.setAttribute("height", "18");
  line.setAttribute(
    "points",
    values
      .map((x, k) => `${4 + (72 * k) / Math.max(1, values.length - 1)},${15 - (12 * (x - low)) / wide}`)
      .join(" "),
  );
  line.setAttribute("fill", "none");
  line.setAttribute("stroke", "currentColor");
  line.setAttribute("stroke-width", "1.5");
  svg.append(line);
  return svg;
};

// The identification while it runs: stage, best answer so far, its residuals and held-out error; it can be ended early.
export const solve = (root, now) => {
  const options = h("div"),
    bar = h("div"),
    live = h("div");
  let drawn = "",
    ticking = 0;
  put(
    root,
    h("h2", {}, "Solve"),
    h(
      "p.how",
      {},
      "Estimates by several methods compete, and held-out prediction decides. The page may be closed meanwhile.",
    ),
    options,
    bar,
    live,
  );
  const drawOptions = ({ project }) => {
    const key = JSON.stringify(project);
    if (key === drawn) return;
    drawn = key;
    const field = (name, label, about = {}) =>
      h(
        "label",
        {},
        label,
        h("input", {
          type: "number",
          step: "any",
          min: 0,
          value: project[name] ?? "",
          placeholder: about.none || "–",
          onchange: (event) =>
            change({ [name]: event.target.value === "" ? null : Number(event.target.value) }),
        }),
      );
    put(
      options,
      h(
        ".row",
        {},
        h(
          "label",
          {},
          "Method",
          choice(
            project.method || "lo-diransac",
            METHODS.map((x) => [x, x]),
            {
              onchange: (event) =>
                change({ method: event.target.value === "lo-diransac" ? null : event.target.value }),
            },
          ),
        ),
        field("time-limit", "Time limit, s", { none: "none" }),
        field("horizon", "Horizon, s", { none: "several" }),
        h(
          "label",
          {},
          "Seed",
          h("input", {
            type: "number",
            step: 1,
            value: project.seed ?? 0,
            onchange: (event) => change({ seed: Math.round(Number(event.target.value)) || null }),
          }),
        ),
        h(
          "label",
          {},
          h("input", {
            type: "checkbox",
            checked: project["with-suggestions"] || false,
            onchange: (event) => change({ "with-suggestions": event.target.checked || null }),
          }),
          "and again with the terms it suggests",
        ),
        !["lo-diransac", undefined].includes(project.method) &&
          h(
            "label",
            {},
            h("input", {
              type: "checkbox",
              checked: project.differentiate || false,
              onchange: (event) => change({ differentiate: event.target.checked || null }),
            }),
            "differentiate what is not measured",
          ),
      ),
    );
  };
  const drawLive = (job) => {
    const steps = job.steps,
      last = steps.at(-1),
      answers = steps.filter((x) => Object.keys(x.parameters).length),
      best = answers.at(-1);
    const residuals = steps.filter((x) => Object.keys(x.residuals).length).at(-1),
      note = steps.filter((x) => x.note).at(-1);
    const words = {
      running: last ? last.stage : "reading",
      done: "done",
      failed: "failed",
      stopped: "stopped",
    }[job.status];
    put(
      live,
      h("progress", {
        max: 1,
        value: job.status === "done" ? 1 : last ? last.fraction : 0,
        "aria-label": "progress",
      }),
      h(
        "p",
        {},
        h("strong", {}, words),
        `  ${job.status === "running" && last ? `${Math.round(100 * last.fraction)} %, ` : ""}${number(job.seconds, 3)} s`,
      ),
      job.status === "failed" &&
        h(
          "p.error",
          {},
          job.error,
          /fix/.test(job.error) &&
            h("p", {}, h("a.button", { href: "#model" }, "Give known values in Model")),
        ),
      note && h("p", {}, note.note),
      h(
        ".columns",
        {},
        best &&
          h(
            "div",
            {},
            h("h3", {}, job.status === "running" ? "Best answer so far" : "Last answer of the search"),
            table(
              ["parameter", "value", ""],
              Object.entries(best.parameters).map(([name, x]) => [
                name,
                number(x, 5),
                spark(answers.map((y) => y.parameters[name] ?? x)),
              ]),
            ),
          ),
        residuals &&
          h(
            "div",
            {},
            h("h3", {}, "Its residuals"),
            table(
              ["signal", "standard deviation"],
              Object.entries(residuals.residuals).map(([name, x]) => [name, number(x, 3)]),
            ),
          ),
      ),
      job.status === "done" && h("p", {}, h("a.button", { href: "#results" }, "See the results")),
    );
  };
  return (state) => {
    drawOptions(state);
    const job = state.jobs.solve,
      running = job?.status === "running",
      why =
        state.commands.solve.shell.startsWith("#") ||
        !state.project.model ||
        !(state.project.logs || []).length;
    put(
      bar,
      h(
        ".row",
        {},
        h("button.main", { type: "button", disabled: running || why, onclick: () => run("solve") }, "Solve"),
        running &&
          h(
            "button",
            { type: "button", onclick: () => post("stop", { kind: "solve", at_once: false }) },
            "Stop and keep the best",
          ),
        running &&
          h(
            "button",
            { type: "button", onclick: () => post("stop", { kind: "solve", at_once: true }) },
            "Abort",
          ),
        why && h("span.how", {}, "Choose a log in Data and a model in Model first."),
      ),
    );
    clearInterval(ticking);
    if (!job) {
      put(live);
      return;
    }
    drawLive(job);
    const began = performance.now() - 1000 * job.seconds;
    if (running)
      ticking = setInterval(() => {
        if (!root.isConnected || !live.isConnected) clearInterval(ticking);
        else drawLive({ ...job, seconds: (performance.now() - began) / 1000 });
      }, 500);
  };
};
