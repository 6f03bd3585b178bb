import {
  button,
  change,
  choice,
  h,
  number,
  numberField,
  places,
  post,
  put,
  run,
  table,
  toStage,
  unchanged,
} from "./page.js";

const METHODS = ["lo-diransac", "i-diransac", "diransac", "nls", "ols", "tls"];
const spark = (values) => {
  const low = Math.min(...values),
    wide = Math.max(...values) - low || 1,
    last = Math.max(1, values.length - 1);
  const make = (name, attributes) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    return element;
  };
  const points = values.map((x, k) => `${4 + (72 * k) / last},${15 - (12 * (x - low)) / wide}`).join(" "),
    svg = make("svg", { viewBox: "0 0 80 18", width: 80, height: 18 });
  svg.append(make("polyline", { points, fill: "none", stroke: "currentColor", "stroke-width": 1.5 }));
  return svg;
};

// The identification while it runs: stage, best answer so far, its residuals and held-out error; it can be ended early.
export const solve = (root, now) => {
  const [options, bar, live] = places(3);
  let ticking = 0;
  put(
    root,
    h("h2", "Solve"),
    h(
      "p.how",
      "Estimates by several methods compete, and held-out prediction decides. The page may be closed meanwhile.",
    ),
    options,
    bar,
    live,
  );
  const drawOptions = ({ project }) => {
    if (unchanged(options, project)) return;
    const method = project.method || METHODS[0],
      terms = project["add-terms"] || [];
    const field = (name, label, placeholder) => {
      const set = (text) => change({ [name]: text === "" ? null : Number(text) });
      return h("label", label, numberField(project[name], set, { min: 0, placeholder }));
    };
    const tick = (name, text) => {
      const onchange = (event) => change({ [name]: event.target.checked || null });
      return h("label", h("input", { type: "checkbox", checked: project[name] || false, onchange }), text);
    };
    put(
      options,
      h(
        ".row",
        h(
          "label",
          "Method",
          choice(method, METHODS, (name) => change({ method: name === METHODS[0] ? null : name })),
        ),
        field("time-limit", "Time limit, s", "none"),
        field("horizon", "Horizon, s", "several"),
        h(
          "label",
          "Seed",
          numberField(project.seed ?? 0, (text) => change({ seed: Math.round(Number(text)) || null }), {
            step: 1,
          }),
        ),
        tick("with-suggestions", "and again with the terms it suggests"),
        method !== METHODS[0] && tick("differentiate", "differentiate what is not measured"),
      ),
      terms.length > 0 &&
        h(
          ".row",
          h("span.how", "Terms to add, once they are suggested:"),
          terms.map((name) =>
            button(`${name}  ✕`, () => change({ "add-terms": terms.filter((x) => x !== name) }), {
              className: "chip",
              title: "take it back",
            }),
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
        h("strong", words),
        `  ${job.status === "running" && last ? `${Math.round(100 * last.fraction)} %, ` : ""}${number(job.seconds, 3)} s`,
      ),
      job.status === "failed" &&
        h(
          "p.error",
          job.error,
          /fix/.test(job.error) && h("p", toStage("model", "Give known values in Model")),
        ),
      note && h("p", note.note),
      h(
        ".columns.even",
        best &&
          h(
            "div",
            h("h3", job.status === "running" ? "Best answer so far" : "Last answer of the search"),
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
            h("h3", "Its residuals"),
            table(
              ["signal", "standard deviation"],
              Object.entries(residuals.residuals).map(([name, x]) => [name, number(x, 3)]),
            ),
          ),
      ),
      job.status === "done" && h("p", toStage("results", "See the results")),
    );
  };
  const stop = (text, atOnce) => button(text, () => post("stop", { kind: "solve", at_once: atOnce }));
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
        button("Solve", () => run("solve"), { className: "main", disabled: running || why }),
        running && [stop("Stop and keep the best", false), stop("Abort", true)],
        why && h("span.how", "Choose a log in Data and a model in Model first."),
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
